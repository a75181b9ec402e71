"""The figures and tables of the paper, and our own studies: a page each. `common` is shared."""
