"""Tasks on MuJoCo's own C library, with Gymnasium's semantics, as pure environments.

`tasks` has the tasks, and `environment` what they have in common. `physics` is a model's reset and
step in JAX; `step.cc` calls MuJoCo from within compiled programs, and `library` builds it. The
tasks need the extra `mujoco`, a C++ compiler when they are first used, and the CPU. `brax` has
other physics for halfcheetah.
"""
