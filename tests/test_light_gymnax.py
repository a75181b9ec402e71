"""gymnax comes without what draws pictures, and is all there for whoever asks."""

import subprocess
import sys

LIGHT = """
import sys
import sejax
assert sejax.envs.make("cartpole").max_steps == 200
import sejax.proxies.base
from gymnax.environments import environment, spaces
from gymnax.environments.classic_control import cartpole
sejax.load("cartpole")
print(sorted({"seaborn", "pandas", "scipy.stats", "matplotlib"} & set(sys.modules)))
"""
FAILS = """
import gymnax
sys.modules["seaborn"] = None  # as if it were not installed
for _ in range(2):
    try:
        gymnax.make
    except ImportError as error:
        print(error.name)
del sys.modules["seaborn"]
"""
# What gymnax offers, whoever imported it first.
USE = """
import gymnax
assert gymnax.make("CartPole-v1")[0].name == "CartPole-v1"
from gymnax.registration import make, registered_envs
assert make is gymnax.make and registered_envs is gymnax.registered_envs
assert gymnax.environments.Pong is gymnax.environments.misc.pong.Pong
assert set(gymnax.__all__) < set(dir(gymnax))
assert type(gymnax) is type(gymnax.environments) is type(sys)
import gymnax.visualize
assert gymnax.visualize.Visualizer.__module__ == "gymnax.visualize.visualizer"
import sejax
assert gymnax.make(sejax.register_gymnax()[0])[0].default_params.weights
assert sejax.envs.make("gymnax/Pong-misc").num_actions == 3
try:
    gymnax.no_such_name
except AttributeError as error:
    print(error)
"""
NO_NAME = "module 'gymnax' has no attribute 'no_such_name'"


def output(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_nothing_that_draws_is_imported_until_gymnax_is_asked_for_it():
    assert output(LIGHT + FAILS + USE) == ["[]", "seaborn", "seaborn", NO_NAME]


def test_gymnax_is_left_alone_where_it_was_imported_first():
    first = "import sys, gymnax.environments.misc\nmake = gymnax.make\n"
    assert output(f"{first}{USE}assert gymnax.make is make") == [NO_NAME]
