"""Environments that are our own; what gymnax has is taken from there."""
