"""What the experiments share. None of these modules is a command."""
