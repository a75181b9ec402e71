"""Search of hyperparameters: ranges, the study, and its trials, which are runs."""
