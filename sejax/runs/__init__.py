"""The commands' parts: configuration, run directories, progress, trackers, plots.

Nothing below imports it. A run goes `words` (words to a tree) -> `command_config` (a tree to a
configuration) -> `config` (that of a run) -> `chunks` (compiled generations) -> `session` (the
driver of a run) -> `run_directory` (its one checkpoint) -> `store` (files of the same settings).
"""
