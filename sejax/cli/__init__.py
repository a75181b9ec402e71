"""The application around the library: command line, run directories, progress, pictures.

Nothing below imports it. A run goes `compose` (Hydra) -> `build` (objects) -> `session` (the one
driver of a run).
"""
