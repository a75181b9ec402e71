"""Stored proxies for the agents of Gymnasium and Stable-Baselines3, in NumPy.

`make` makes an environment of a synthetic environment (SE) or a reward network (RN), `make_vec` and
`make_sb3` vector environments, and `RewardNetwork` puts an RN around an environment that you have.
Importing this module registers the shipped proxies as `sejax/<name>`. Gymnasium imports it for
`sejax.gym:sejax/<name>`, in other processes too. It starts no backend of JAX, so environments fork
and pickle as others do. Extras: `gym`, and `sb3` for `make_sb3`. How to use it: docs/gymnasium.md.

Example:
  >>> import gymnasium
  >>> env = gymnasium.make("sejax.gym:sejax/cartpole")  # or make(...), of a run directory
  >>> obs, info = env.reset(seed=0)
  >>> obs, reward, terminated, truncated, info = env.step(1)
  >>> obs.shape, terminated, truncated  # episodes of the shipped SEs have one step
  ((4,), True, False)
"""

from sejax.gym.registration import make as make
from sejax.gym.registration import make_sb3 as make_sb3
from sejax.gym.registration import make_vec as make_vec
from sejax.gym.registration import register as register
from sejax.gym.reward import RewardNetwork as RewardNetwork
from sejax.gym.synthetic import SyntheticGymEnv as SyntheticGymEnv
from sejax.gym.synthetic import SyntheticVectorEnv as SyntheticVectorEnv
from sejax.gym.synthetic import SyntheticWorld as SyntheticWorld
from sejax.gym.tasks import GYMNASIUM_IDS as GYMNASIUM_IDS
from sejax.gym.tasks import GridWorld as GridWorld
from sejax.gym.tasks import RealTask as RealTask

register()
