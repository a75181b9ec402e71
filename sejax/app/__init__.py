"""What the commands are made of; the library below does not know of it."""
