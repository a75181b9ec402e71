"""The commands' parts: configuration, run directories, progress, trackers, plots.

Nothing below imports it. A run goes `config` (overrides to a configuration) -> `session` (the
driver of a run) -> `run_directory` (its one checkpoint) -> `store` (files of the same settings).
"""
