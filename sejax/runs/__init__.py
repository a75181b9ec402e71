"""The commands' parts: configuration, run directories, progress, trackers, plots.

Nothing below imports it. A run goes `compose` (words to a tree) -> `config` (a tree to a
configuration) -> `chunks` (compiled generations) -> `session` (the driver of a run) ->
`run_directory` (its one checkpoint) -> `store` (files of the same settings).
"""
