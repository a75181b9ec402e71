"""Learned stand-ins for real tasks, as gymnax environments whose params are weights."""

from sejax.envs import light_gymnax

light_gymnax.install()
