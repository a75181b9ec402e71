"""Environments that need JAX alone."""
