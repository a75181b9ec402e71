"""The wheel and the sdist, as whoever installs them meets them: `make dist` makes and tests them.

The wheel is installed into an environment of its own, and all that is run there is run in a folder
that is not the repository.
"""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from support import printed
from test_examples import NEEDS, PRINTS, TINY

import sejax

pytestmark = pytest.mark.dist
ROOT = Path(__file__).parents[1]

# What a user's first lines are.
SCRIPT = """\
import jax

import sejax
import sejax.gym

proxy = sejax.load_proxy("cartpole")
agent = sejax.make_agent(sejax.DDQNConfig(warmup_episodes=1, hidden_size=4), proxy.task)
training = sejax.TrainingConfig(max_steps=20, stop_rule="never")
train = sejax.make_trainer(agent, proxy.env, training)
trained: sejax.TrainResult = jax.jit(train)(jax.random.key(0), proxy.params)
learn = sejax.make_learner(sejax.config(["env=gridworld_2x2", "agent=q_learning"]))
shapes: sejax.LearnResult = jax.eval_shape(learn, jax.random.key(0))
env = sejax.gym.make("cartpole")
env.reset(seed=0)
obs, reward, terminated, truncated, info = env.step(1)
print(int(trained.train_steps), shapes.score.shape, float(reward) < 1e9, len(sejax.pretrained()))
"""


def one(pattern):
    """The file in dist/; `make dist` leaves one of each."""
    (path,) = (ROOT / "dist").glob(pattern)
    return path


@pytest.fixture(scope="module")
def wheel():
    with zipfile.ZipFile(one("*.whl")) as wheel:
        yield {name: wheel.read(name) for name in wheel.namelist() if not name.endswith("/")}


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The interpreter of a bare environment with the wheel."""
    folder = tmp_path_factory.mktemp("bare")
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    install(python, one("*.whl"))
    return python


def install(python, *what):
    pip = [python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt"]
    subprocess.run([*pip, *what], check=True)


@pytest.fixture
def run(python, tmp_path):
    """Runs the environment's Python in an empty folder and returns what it printed."""

    def run(*words):
        environ = {name: x for name, x in os.environ.items()
                   if name not in ("PYTHONPATH", "XLA_FLAGS")}  # fmt: skip
        return printed(python, *words, cwd=tmp_path, env=environ)

    return run


# --- what is in them -----------------------------------------------------------------------------


def of_git(folder):
    """Files of the repository in a folder, new ones too."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", folder]
    return {name for name in printed(*command, cwd=ROOT).splitlines() if (ROOT / name).exists()}


def test_the_wheel_is_the_package_as_git_has_it(wheel):
    """It is built of what the sdist holds (`python -m build`), which hence is enough."""
    package = {name: x for name, x in wheel.items() if ".dist-info/" not in name}
    assert set(package) == of_git("sejax")
    assert all((ROOT / name).read_bytes() == x for name, x in package.items())
    assert {"sejax/envs/mujoco/step.cc", "sejax/presets/cartpole-se.yaml", "sejax/py.typed",
            "sejax/pretrained/cartpole.safetensors"} < set(package)  # fmt: skip


# --- what they do, bare --------------------------------------------------------------------------


def test_what_is_imported_is_the_wheel(run, python):
    place, version = run("-c", "import sejax; print(sejax.__file__, sejax.__version__)").split()
    assert Path(place).is_relative_to(python.parents[1]) and version == sejax.__version__


def test_the_commands_run(run):
    tiny = ["env=gridworld_2x2", "proxy.hidden_size=4", "es.population_size=2", "generations=1",
            "es.num_incumbent_evals=1", "training.max_steps=30", "devices=1",
            "run_dir=here"]  # fmt: skip
    assert "here/proxy.safetensors" in run("-m", "sejax.run", *tiny)
    evaluated = run("-m", "sejax.evaluate", "proxy=here", "agent=q_learning", "num_agents=2",
                    "devices=1", "real_training.max_episodes=2")  # fmt: skip
    assert "here/evaluation.csv" in evaluated
    assert "preset" in run("-m", "sejax.run", "--help")


@pytest.mark.parametrize("name", sorted(set(TINY) - set(NEEDS)))
def test_the_examples_run(name, run, tmp_path):
    shutil.copy(ROOT / "examples" / f"{name}.py", tmp_path)
    assert re.search(PRINTS[name], run(f"{name}.py", *TINY[name]))


# --- with the extra gym --------------------------------------------------------------------------


def test_a_users_script_runs_and_mypy_finds_nothing_in_it(run, python, tmp_path):
    install(python, f"{one('*.whl')}[gym]")
    (tmp_path / "script.py").write_text(SCRIPT)
    count = len(sejax.pretrained())
    assert run("script.py") == f"20 () True {count}\n"
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable", python,
            "--cache-dir", tmp_path / "cache", "script.py"]  # fmt: skip
    printed(*mypy, cwd=tmp_path)
