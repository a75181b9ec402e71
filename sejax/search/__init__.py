"""`python -m sejax.search`: hyperparameters by Optuna, with NES generations as the budget.

A trial is a run directory. It tells the study its score after each generation, from its files,
and ends there if the pruner says so. Optuna's Hyperband never stops a trial to go on with it later:
each trial belongs to a bracket by its number, is compared at generations 3, 9, 27, ... with those
of its bracket that have come as far, and is pruned or goes on at once. To be promoted is to go on;
what goes on from a checkpoint is a trial whose process died. It is queued again under a new number,
with the same settings, in a copy of its directory, and its generations so far are told anew.

Optuna is imported by the parts alone, never by `import sejax`.
"""
