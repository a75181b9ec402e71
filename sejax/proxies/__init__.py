"""Learned stand-ins for real tasks, as gymnax environments whose params are weights."""

# A state or reward beyond this is no world that an agent could learn from: the episode ends. It is
# far outside every task's range and small enough for its square to stay finite in float32.
ABSURD = 1e6
