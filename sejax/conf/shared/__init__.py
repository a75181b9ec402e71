"""Groups that more than one command takes."""
