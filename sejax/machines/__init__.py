"""One run over many machines: the state in one place, the trainings wherever there is room.

A command's process, the driver, holds the strategy, its state and all files. Worker processes hold
the compiled trainings. In a generation candidates go out in shares and outcomes come back. What a
training gives depends on its key and its candidate alone, so that it does not matter who computed
it, how often, or in which order: the numbers are those of a single process.

================== ================================================================================
`configs.py`       what `machines=` chooses: `local` or `ray`
`chunks.py`        generations of a run whose trainings are elsewhere, for `sejax.cli.session`
`handout.py`       who gets which share; workers that die, hang, lie, come and go
`scorer.py`        a worker: the compiled trainings
`ray_crew.py`      workers as Ray's actors
`ledger.py`        `machines.csv`: who computed what
================== ================================================================================
"""
