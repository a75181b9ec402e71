"""What several test modules share: plain references, and a reader of compiled programs."""

import csv
import dataclasses
import functools
import math
import os
import re
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from sejax.evaluate import EvaluateConfig
from sejax.objectives import Outcome
from sejax.ops.checksummed import pack, unpack
from sejax.options import ConfigError
from sejax.proxies.synthetic import SyntheticConfig
from sejax.runs.config import config
from sejax.training import TrainingConfig

# A room of 2 x 2 cells for tables: what takes time is importing and compiling.
ROOM = [
    "env=gridworld_2x2", "proxy.hidden_size=4", "es.population_size=2", "es.num_incumbent_evals=2",
    "es.noise_std=1.0", "training.max_steps=30", "training.test_episodes=1", "generations=3",
]  # fmt: skip


def paper_se(**fields):
    """The paper's SE, of whole episodes, but for these fields."""
    return SyntheticConfig(**{"initial_state": "real", "horizon": None, "done": "soft"} | fields)


def paper_ppo(**fields):
    """The paper's PPO, but for these fields."""
    words = ["env=mountain_car_continuous", "proxy=rn", "agent=ppo", "preset=paper"]
    return dataclasses.replace(config(words).agent, **{"action_repeat": 1} | fields)


def paper_training(**fields):
    """The paper's training, which ends by its returns, but for these fields."""
    paper = {"max_steps": None, "max_episodes": 1000, "stop_rule": "plateau"}
    paper |= {"time_limit_is_terminal": True}
    return TrainingConfig(**paper | fields)


def shapes_of(fn, *args):
    """What `fn(*args)` returns, as zeros in NumPy; nothing is compiled."""
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(fn, *args))


def random_like(tree, seed=0, scale=0.5):
    """Normal numbers in the place of a pytree's; nothing is compiled."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: np.float32(scale * rng.normal(size=x.shape)), tree)


def raveled(tree):
    """A pytree of arrays as one vector, as `ravel_pytree`, in NumPy."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


def unraveled(vector, like):
    """Inverse of `raveled`, for a pytree of arrays like these."""
    leaves, structure = jax.tree.flatten(like)
    parts = np.split(np.asarray(vector), np.cumsum([np.size(x) for x in leaves])[:-1])
    return structure.unflatten(
        [part.reshape(np.shape(x)) for part, x in zip(parts, leaves, strict=True)]
    )


def arrays_of(tree):
    """The leaves of a pytree as NumPy arrays; keys as their data."""

    def plain(x):
        is_key = isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    return [plain(x) for x in jax.tree.leaves(tree)]


def assert_close(a, b, **tolerance):
    """The numbers of two pytrees are close."""
    for x, y in zip(arrays_of(a), arrays_of(b), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


def assert_equal(a, b):
    """The numbers of two pytrees are the same."""
    for x, y in zip(arrays_of(a), arrays_of(b), strict=True):
        np.testing.assert_array_equal(x, y)


def bits(tree):
    """The leaves of a pytree as bytes, with their dtypes and shapes; keys as their data."""
    return [f"{x.dtype}{x.shape}".encode() + x.tobytes() for x in arrays_of(tree)]


def numpy_forward(params, x, activation, num_layers, prelu_slope=0.25):
    """The MLP on a single input `[in]`, in NumPy and doubles."""
    activate = {
        "tanh": np.tanh,
        "fast_tanh": np.tanh,  # within the tolerance of whoever compares
        "relu": lambda x: np.maximum(x, 0),
        "leaky_relu": lambda x: np.where(x >= 0, x, 0.01 * x),
        "prelu": lambda x: np.where(x >= 0, x, prelu_slope * x),
    }[activation]
    for layer in range(num_layers + 1):
        dense = jax.tree.map(np.float64, params[f"Dense_{layer}"])
        x = dense["kernel"] @ x + dense["bias"]
        if layer < num_layers:
            x = activate(x)
    return x


def batch_of(rng, obs_dim, batch_size):
    """A batch's arrays but for its actions; discounts are such as an SE's soft done output."""
    arrays = {
        "obs": rng.normal(size=(obs_dim, batch_size)),
        "reward": rng.normal(size=batch_size),
        "discount": rng.uniform(-0.2, 1.2, batch_size),
        "next_obs": rng.normal(size=(obs_dim, batch_size)),
    }
    return {name: np.float32(x) for name, x in arrays.items()}


@functools.cache
def drawing(agent):
    """The actions of 4000 keys, `(state, obs) -> (exploring, testing)`, jitted."""

    @jax.jit
    def draw(state, obs):
        keys = jax.random.split(jax.random.key(1), 4000)
        return [
            jax.vmap(lambda key, e=explore: agent.act(key, state, obs, e))(keys)
            for explore in (True, False)
        ]

    return draw


def assert_shares(drawn, expected):
    """Each index is drawn as often as expected, within five standard deviations."""
    share = np.bincount(drawn, minlength=len(expected)) / drawn.size
    deviation = np.sqrt(expected * (1 - expected) / drawn.size)
    assert (np.abs(share - expected) <= 5 * deviation + 1e-7).all()


# Ops that pass a buffer on or write into it in place.
IN_PLACE = {
    "parameter", "get-tuple-element", "tuple", "while", "conditional", "call", "fusion", "bitcast",
    "dynamic-update-slice", "scatter",
}  # fmt: skip


def large_ops_in_loops(hlo, num_elements):
    """Ops in the loops of a compiled program that make a new array of at least this size.

    Returns `(op, line)` for each op of a `while` body, or of what it calls, whose result has at
    least `num_elements` elements and that is not one of `IN_PLACE`. What runs once before a loop
    is not listed.
    """
    computations, name = {}, None
    for line in hlo.splitlines():
        header = re.match(r"(?:ENTRY )?%?([\w.\-]+) \(.*\) -> .*\{$", line)
        if header:
            name = header.group(1)
            computations[name] = []
        elif name:
            computations[name].append(line.strip())
    reached, pending = set(), set(re.findall(r"body=%?([\w.\-]+)", hlo))
    assert pending, "the program has no loop"
    while pending:
        reached |= pending
        text = "\n".join(line for name in pending for line in computations[name])
        pending = (computations.keys() & set(re.findall(r"[\w.\-]+", text))) - reached
    large = []
    for line in (line for name in sorted(reached) for line in computations[name]):
        op = re.search(r"= \w+\[([\d,]*)\]\S* ([\w\-]+)\(", line)  # results that are no tuple
        if op and math.prod(int(d) for d in op.group(1).split(",") if d) >= num_elements:
            large.append((op.group(2), line))
    return [(op, line) for op, line in large if op not in IN_PLACE]


def metrics(folder):
    """The rows of a run, without the one column that depends on the clock."""
    with (folder / "metrics.csv").open(newline="") as file:
        return [{k: x for k, x in row.items() if k != "wall_s"} for row in csv.DictReader(file)]


def refuse(*_, **__):
    """Stands in for what must not be computed again."""
    raise AssertionError("computed again")


def is_drawn(path):
    """Whether a picture has ink of several colours on more than a hundredth of it."""
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    inked = pixels[(pixels != 255).any(axis=1)]
    return len(inked) > len(pixels) / 100 and len(np.unique(inked, axis=0)) > 10


def printed(*command, **options):
    """What a command prints, which must end well."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ended(monkeypatch, capsys, command, *words):
    """The exit status, the output and the errors of a command of this process."""
    monkeypatch.setattr(sys, "argv", ["sejax", *words])
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(os, "environ", dict(os.environ))
    try:
        command()
        status = 0
    except SystemExit as left:
        status = left.code
    return status, *capsys.readouterr()


def has_compiler():
    """Whether MuJoCo's library can be built here."""
    return shutil.which((os.environ.get("CXX") or "c++").split()[0]) is not None


def outcome_of(returns):
    """The outcome of agents with these test returns; nan for those that diverged."""
    returns, counts = jnp.float32(returns), jnp.ones(len(returns), jnp.int32)
    return Outcome(
        test_returns=returns[:, None], scored_returns=returns[:, None], train_steps=counts,
        train_episodes=counts, auc=returns, nonfinite=~jnp.isfinite(returns), real_steps=counts,
    )  # fmt: skip


evaluation = EvaluateConfig.of_words


def forge(path, **config):
    """Changes the configuration in a proxy's file, which keeps a right checksum."""
    tensors, header = unpack(path.read_bytes(), "sejax")
    path.write_bytes(pack(tensors, "sejax", header | {"config": header["config"] | config}))


def refusal(call, *args, **kwargs):
    """The error of a call that is refused: one short message that names a field."""
    with pytest.raises(ConfigError) as caught:
        call(*args, **kwargs)
    assert "\n" not in str(caught.value) and len(str(caught.value)) <= 300
    return caught.value


def refused(call, *args, **kwargs):
    """The field that a refused call names."""
    return refusal(call, *args, **kwargs).field
