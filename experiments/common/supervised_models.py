"""Models of a task, fitted by supervised learning to what agents of NES runs met in it.

Source: paper, appendix "Supervised Learning and Synthetic Environments", subsection "Comparing
Supervised Learning with Synthetic Environments on CartPole"; `docs/reference.md` 7.5.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd

import sejax
from experiments.common import agents
from experiments.common.agents import HPARAMS, SE_AGENTS, SOFT_SE
from experiments.common.experiment import Settings, count, setting
from sejax import ProxySet
from sejax.bilevel import make_bilevel
from sejax.cli import config as configuration
from sejax.evaluation import make_evaluator, num_parallel_on_cpu
from sejax.ops.parallel import spread_over_devices
from sejax.options import each_of, registry

LEARNING_RATE, BATCH_SIZE = 1e-4, 1024  # paper and docs/reference.md 7.5
DRAWN = "_drawn"


@dataclass(frozen=True, kw_only=True)
class SupervisedBaseline(Settings):
    """Settings of the experiment `supervised_baseline`."""

    name = "supervised_baseline"

    proxy: str = setting(SOFT_SE)  # SE to compare with; run directory, file or shipped name
    models: int = count(5, quick=2)  # NES runs, and a model for each
    generations: int = count(25, quick=3)  # of an NES run
    population: int = count(16, least=2, quick=3)  # candidates of a generation
    max_rows: int = count(100_000, quick=3000)  # transitions for a model
    epochs: int = count(100, quick=20)  # of a fit
    agents: tuple[str, ...] = setting(("ddqn",), each_of(SE_AGENTS))  # ddqn, dueling_ddqn, ...
    hparams: tuple[str, ...] = setting(HPARAMS, each_of(HPARAMS))  # varied: drawn for each agent
    num_agents: int = count(20, quick=2)  # for each model
    test_episodes: int = count(10)  # of each agent
    max_steps: int | None = count(None)  # of an agent on a model; as on the SE


def learning_config(settings: SupervisedBaseline, ses: ProxySet) -> Any:
    """Settings of the NES runs that the transitions come from."""
    config = configuration.learn_config(ses.config)
    agent, training = config.agent, config.training
    training = dataclasses.replace(training, test_episodes=settings.test_episodes)
    if settings.quick:
        agent = dataclasses.replace(agent, **agents.QUICK_AGENT)
        training = dataclasses.replace(training, max_steps=agents.QUICK_STEPS)
    es = dataclasses.replace(
        config.es, population_size=settings.population, num_incumbent_evals=settings.population
    )
    return dataclasses.replace(
        config,
        agent=agent,
        training=training,
        es=es,
        generations=settings.generations,
        seed=settings.seed,
        num_seeds=1,
        devices=settings.devices,
        run_dir=None,
    )


def collect_all(settings: SupervisedBaseline, ses: ProxySet) -> list[pd.DataFrame]:
    """The transitions of each NES run; every run is a shard."""
    config = learning_config(settings, ses)
    made_with = configuration.plain(config) | {"max_rows": settings.max_rows, "devices": None}
    tables = []
    for index in range(settings.models):
        seed = settings.seed + index
        make = functools.partial(collect, config, seed, settings.max_rows)
        rows = settings.shards.compute(f"transitions-{index}", made_with | {"seed": seed}, make)
        print(
            f"NES run {index}: {len(rows):,} transitions of episodes with mean return "
            f"{rows['return'].mean():.1f}",
            flush=True,
        )
        tables.append(rows)
    return tables


def collect(config: Any, seed: int, max_rows: int) -> pd.DataFrame:
    """Runs NES and draws transitions, all equally likely, from its agents' real test episodes."""
    init, generation = make_recorded_run(config)
    state, rng = init(jax.random.key(seed)), np.random.default_rng(seed)
    kept = None
    for number in range(config.generations):
        state, steps = generation(state)
        rows = table_of(jax.device_get(steps), config.training.test_episodes, number)
        kept = sampled(kept, rows, max_rows, rng)
    return pd.DataFrame() if kept is None else kept.drop(columns=DRAWN)


@functools.cache
def make_recorded_run(config: Any) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """The NES run of a configuration, whose agents' tests are recorded, compiled for any seed.

    Returns:
      `init(key) -> state`, and `generation(state) -> (state, Steps)`, which makes a generation; the
      steps are those of all tests, `[evaluation, step, ...]`.
    """
    bilevel = make_bilevel(**config.parts())
    proxy, training = bilevel.proxy, bilevel.training
    (agent,) = bilevel.mixture.agents
    evaluate = make_evaluator(agent, proxy, proxy.task, training, record=True)
    evaluate_all = spread_over_devices(
        lambda key, candidate: evaluate(key, proxy.params(bilevel.unravel(candidate))),
        config.devices,
        config.num_parallel,
        num_parallel_on_cpu(agent, training),
    )

    def generation(state: Any) -> Any:
        candidates = bilevel.ask(state)
        outcome, steps = evaluate_all(candidates.keys, candidates.params)
        state, _ = bilevel.tell(state, candidates, outcome)
        return state, steps

    return jax.jit(bilevel.init), jax.jit(generation)


def table_of(steps: Any, num_episodes: int, generation: int) -> pd.DataFrame:
    """The transitions that were made, a row each, with the return of their episode.

    `steps` are `Steps` of NumPy arrays `[agent, num_episodes * max_steps, ...]`.
    """
    valid = steps.valid
    rewards = np.where(valid, steps.reward, 0).reshape(len(valid), num_episodes, -1)
    returns = np.broadcast_to(rewards.sum(axis=2, keepdims=True), rewards.shape)
    obs, next_obs = steps.obs[valid], steps.next_obs[valid]
    return pd.DataFrame(
        {
            **{f"state_{i}": x for i, x in enumerate(obs.T)},
            "action": steps.action[valid],
            **{f"next_state_{i}": x for i, x in enumerate(next_obs.T)},
            "reward": steps.reward[valid],
            "terminated": steps.terminated[valid].astype(int),
            "return": returns.reshape(valid.shape)[valid],
            "generation": generation,
        }
    )


def sampled(
    kept: pd.DataFrame | None, rows: pd.DataFrame, size: int, rng: np.random.Generator
) -> pd.DataFrame:
    """A uniform sample without replacement of all rows so far, in random order.

    Every row draws a number, the column `DRAWN`, and those with the lowest numbers stay.

    Args:
      kept: the sample of the rows before; None if there are none.
      rows: new ones.
      size: of the sample, at most.
      rng: draws the numbers.
    """
    rows = rows.assign(**{DRAWN: rng.uniform(size=len(rows))})
    rows = rows if kept is None else pd.concat([kept, rows], ignore_index=True)
    return rows.nsmallest(size, DRAWN).reset_index(drop=True)


def summary_of(data: list[pd.DataFrame]) -> pd.DataFrame:
    """Of each model its transitions: how many, the mean return of their episodes, share of ends.

    Long episodes, which have many, count more in the mean.
    """
    return pd.DataFrame(
        {
            "model": range(len(data)),
            "transitions": [len(rows) for rows in data],
            "episode_return": [rows["return"].mean() for rows in data],
            "ends": [rows["terminated"].mean() for rows in data],
        }
    )


def model_file(settings: SupervisedBaseline, variant: str) -> Path:
    """Where the models of a variant are stored."""
    return settings.folder / f"models-{variant}.safetensors"


def fit_shard(
    settings: SupervisedBaseline, ses: ProxySet, data: list[pd.DataFrame]
) -> pd.DataFrame:
    """Fits all models, stores both variants of them, and returns the errors of each epoch."""
    num_rows = min(len(rows) for rows in data)
    made_with = {
        "proxy": ses.config["proxy"],
        "num_rows": num_rows,
        "learning_rate": LEARNING_RATE,
        "batch_size": BATCH_SIZE,
    }
    made_with |= settings.values("models", "epochs", "generations", "population", "seed")
    fits = settings.shards.compute("fit", made_with, lambda: fit_all(settings, ses, data, num_rows))
    last = fits[fits["epoch"] == settings.epochs - 1].mean()
    print(
        f"Models: mean squared error {last['error']:.2g} of [s', r], "
        f"{last['done_error']:.2g} of the end",
        flush=True,
    )
    return fits


def fit_all(settings: Any, ses: ProxySet, data: list[pd.DataFrame], num_rows: int) -> pd.DataFrame:
    """Fits a model to each run's transitions and writes the models; a row for each epoch."""
    arrays = [arrays_of(rows.iloc[:num_rows]) for rows in data]
    stacked = tuple(np.stack(parts) for parts in zip(*arrays, strict=True))
    keys = jax.random.split(jax.random.key(settings.seed), settings.models)
    fit = make_fit(ses.env, num_rows, settings.epochs)
    program = jax.jit(spread_over_devices(fit, settings.devices))
    initial, fitted, errors = jax.device_get(program(keys, *stacked))
    save_models(settings, ses, {**fitted, "done": initial["done"]}, "authors", "soft")
    save_models(settings, ses, fitted, "fair", "threshold")
    model, epoch = (place.ravel() for place in np.indices(errors.shape[:2]))
    each = {"error": errors[..., 0].ravel(), "done_error": errors[..., 1].ravel()}
    return pd.DataFrame({"model": model, "epoch": epoch, **each})


def arrays_of(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States `[n, obs_dim]`, actions `[n]`, targets [s', r] and ends `[n]`."""
    states = [name for name in rows if name.startswith("state_")]
    targets = [name for name in rows if name.startswith("next_state_")] + ["reward"]
    state, target, end = (rows[x].to_numpy(np.float32) for x in (states, targets, "terminated"))
    return state, rows["action"].to_numpy(np.int32), target, end


def make_fit(env: Any, num_rows: int, epochs: int) -> Callable[..., Any]:
    """Builds `fit(key, states, actions, targets, ends) -> (initial, fitted, errors [epochs, 2])`.

    The errors are means over an epoch, of [s', r] and of the end. What does not fill the last batch
    of an epoch is left out of it; the order is drawn anew for each.
    """
    batch_size = min(BATCH_SIZE, num_rows)
    num_batches = num_rows // batch_size
    optimizer = optax.adam(LEARNING_RATE)

    def loss(weights: Any, states: Any, actions: Any, targets: Any, ends: Any) -> Any:
        state, reward, done = jax.vmap(env.predict, (None, 0, 0))(weights, states, actions)
        predicted = jnp.concatenate([state, reward[:, None]], axis=1)
        errors = [jnp.mean((predicted - targets) ** 2), jnp.mean((done - ends) ** 2)]
        return sum(errors), jnp.stack(errors)

    def fit(key: Any, *data: Any) -> Any:
        key_init, key_order = jax.random.split(key)
        initial = env.init_weights(key_init)
        data = tuple(map(jnp.asarray, data))

        def update(carry: Any, rows: Any) -> Any:
            weights, opt_state = carry
            batch = (x[rows] for x in data)
            gradient, errors = jax.grad(loss, has_aux=True)(weights, *batch)
            step, opt_state = optimizer.update(gradient, opt_state)
            return (optax.apply_updates(weights, step), opt_state), errors

        def epoch(carry: Any, key_epoch: Any) -> Any:
            order = jax.random.permutation(key_epoch, num_rows)[: num_batches * batch_size]
            carry, errors = jax.lax.scan(update, carry, order.reshape(num_batches, batch_size))
            return carry, errors.mean(axis=0)

        keys = jax.random.split(key_order, epochs)
        (fitted, _), errors = jax.lax.scan(epoch, (initial, optimizer.init(initial)), keys)
        return initial, fitted, errors

    return fit


def save_models(settings: Any, ses: ProxySet, weights: Any, variant: str, done: str) -> None:
    """Stores the models of a variant, as SEs with their use of the done output."""
    env = registry.make("proxy", dataclasses.replace(ses.env.config, done=done), ses.task)
    each = [jax.tree.map(lambda x, i=i: x[i], weights) for i in range(settings.models)]
    records = [
        {"generation": settings.generations, "seed": settings.seed + i}
        for i in range(settings.models)
    ]
    config = ses.config | {"proxy": registry.describe("proxy", env.config)}
    sejax.save_set(model_file(settings, variant), env, each, records, config, ses.discount)
