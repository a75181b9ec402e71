"""Search of hyperparameters: ranges, the study, and its trials, each of which is a run."""
