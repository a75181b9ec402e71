"""What makes sejax fast on CPUs, and the helpers that everything above shares."""
