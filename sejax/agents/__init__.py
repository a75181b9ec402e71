"""RL agents as bundles of pure functions, and the inner loop that trains any of them."""
