"""Search of hyperparameters: ranges, the study, and its trials. Each trial is a run."""
