"""Learned stand-ins for real tasks, as gymnax environments whose params are weights."""
