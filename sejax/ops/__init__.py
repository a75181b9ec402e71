"""What makes programs fast on CPUs, numbers that may not be finite, and files that survive a kill.

Each trick stands for a plain form. It equals this form but for rounding, as tests show; `step_keys`
alone draws other keys. Gains were measured on one core of a shared AMD EPYC, in turns with the
plain form. They are CPU times of whole trainings of the default DDQN in a CartPole SE.

=================== ======================================== ================================
fast                plain                                    gain
=================== ======================================== ================================
`in_batches_on_cpu` `jax.vmap`, all agents at once           1.7 times, TD3 of 2 x 256 units
`while_any_active`  `jax.lax.while_loop` under `vmap`        9 times, 8 agents, 20,000 rows
`networks.affine`   `kernel @ x + bias`                      1.3 times
`networks.tanh`     `jnp.tanh`                               1.1 times (paper's DDQN)
`keys.step_keys`    `jax.random.split(fold_in(key, step))`   1.06 times
=================== ======================================== ================================
"""
