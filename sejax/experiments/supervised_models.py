"""Models of a task, fitted by supervised learning to what agents of NES runs met in it.

Source: paper, appendix "Supervised Learning and Synthetic Environments", subsection "Comparing
Supervised Learning with Synthetic Environments on CartPole"; `reference_details.md` 7.5.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sejax.experiments import common

LEARNING_RATE, BATCH_SIZE = 1e-4, 1024  # paper and reference_details.md 7.5
QUICK_AGENT = {"hidden_size": 8, "num_layers": 1, "batch_size": 8, "init_episodes": 1}
QUICK_STEPS = 1500


def learning_config(args: argparse.Namespace, ses: Any) -> Any:
    """Settings of the NES runs that the transitions come from."""
    config = ses.config
    agent = config.agent
    training = dataclasses.replace(config.training, test_episodes=args.test_episodes)
    if args.quick:
        agent = dataclasses.replace(agent, **QUICK_AGENT)
        training = dataclasses.replace(training, max_steps=QUICK_STEPS)
    es = dataclasses.replace(config.es, population_size=args.population,
                             num_incumbent_evals=args.population)  # fmt: skip
    return dataclasses.replace(config, agent=agent, training=training, es=es, devices=args.devices)


def collect_piece(
    args: argparse.Namespace, ses: Any, index: int, pieces: common.Pieces
) -> pd.DataFrame:
    """The transitions of one NES run."""
    from sejax.configs import to_dict

    config = learning_config(args, ses)
    settings = to_dict(config) | {"generations": args.generations, "max_rows": args.max_rows,
                                  "seed": args.seed + index, "devices": None}  # fmt: skip
    rows = pieces.compute(
        f"transitions-{index}", settings,
        lambda: collect(config, args.seed + index, args.generations, args.max_rows),
    )  # fmt: skip
    print(f"NES run {index}: {len(rows):,} transitions of episodes with mean return "
          f"{rows['return'].mean():.1f}", flush=True)  # fmt: skip
    return rows


def collect(config: Any, seed: int, generations: int, max_rows: int) -> pd.DataFrame:
    """Runs NES and draws transitions, all equally likely, from its agents' real test episodes."""
    import jax

    from sejax.es import make_strategy
    from sejax.objectives import make_objective

    env, unravel, mean = make_proxy(config, seed)
    strategy = make_strategy(config.es, mean.size)
    evaluate = make_recorded_evaluation(config, env, unravel)
    objective = make_objective(config.objective, env.task.solved_reward)
    key_es, key_run = jax.random.split(jax.random.key(seed))
    state = jax.jit(strategy.init)(key_es, mean)
    ask, tell = jax.jit(strategy.ask), jax.jit(strategy.tell)
    rng = np.random.default_rng(seed)
    sample = Sample(max_rows, rng)
    for generation in range(generations):
        key_ask, key_tell, key_inner = jax.random.split(jax.random.fold_in(key_run, generation), 3)
        candidates, asked = ask(key_ask, state)
        keys = jax.random.split(key_inner, strategy.num_candidates)
        outcome, steps = evaluate(keys, candidates)
        state = tell(key_tell, candidates, objective(outcome), asked)
        sample.add(table_of(jax.device_get(steps), generation))
    return sample.table


def make_proxy(config: Any, seed: int) -> tuple[Any, Callable[[Any], Any], Any]:
    """The SE of a configuration, its weights' form, and random ones to begin with, `[dims]`."""
    import jax
    from jax.flatten_util import ravel_pytree

    from sejax.proxies.registry import make_proxy

    env = make_proxy(config.env.make(), config.proxy)
    mean, unravel = ravel_pytree(env.init_weights(jax.random.key(seed)))
    return env, unravel, mean


def make_recorded_evaluation(
    config: Any, env: Any, unravel: Callable[[Any], Any]
) -> Callable[..., Any]:
    """Builds `evaluate(keys [n], candidates [n, dims]) -> (Outcome, transitions)`, leaves `[n]`."""
    import jax
    import jax.numpy as jnp

    from sejax.agents.registry import make_agent
    from sejax.evaluation import make_tested_trainer, return_area
    from sejax.experiments.se_histograms import make_test_recorder
    from sejax.objectives import Outcome
    from sejax.parallel import spread_over_devices

    agent = make_agent(config.agent, env.task, config.exploration)
    train = make_tested_trainer(agent, env, env.task, config.training)
    num_episodes = config.training.test_episodes
    test = make_test_recorder(agent, env.task, num_episodes)

    def one(key: Any, candidate: Any) -> Any:
        key_train, key_test = jax.random.split(key)
        result = train(key_train, env.params(unravel(candidate)))
        steps = test(key_test, result.agent_state)
        rewards = jnp.where(steps.valid, steps.reward, 0.0)
        returns = rewards.reshape(num_episodes, -1).sum(axis=1)
        outcome = Outcome(test_returns=returns, train_steps=result.train_steps,
                          train_episodes=result.episodes,
                          return_area=return_area(result, returns.mean()),
                          nonfinite=result.nonfinite,
                          real_steps=steps.valid.sum() + result.test_steps)  # fmt: skip
        return outcome, (steps, jnp.repeat(returns, env.task.max_steps))

    return jax.jit(spread_over_devices(one, config.devices, config.lanes, agent.cpu_lanes))


def table_of(steps_and_returns: Any, generation: int) -> pd.DataFrame:
    """The transitions that were made, a row each, with the return of their episode."""
    steps, returns = steps_and_returns
    valid = steps.valid
    obs, next_obs = steps.obs[valid], steps.next_obs[valid]
    columns = {f"state_{i}": obs[:, i] for i in range(obs.shape[1])}
    columns |= {"action": steps.action[valid]}
    columns |= {f"next_state_{i}": next_obs[:, i] for i in range(obs.shape[1])}
    return pd.DataFrame(columns | {
        "reward": steps.reward[valid], "terminated": steps.terminated[valid].astype(int),
        "return": returns[valid], "generation": generation,
    })  # fmt: skip


class Sample:
    """A uniform sample without replacement of all rows that were ever added."""

    def __init__(self, size: int, rng: np.random.Generator):
        self.size = size
        self._rng = rng
        self._rows: pd.DataFrame | None = None

    def add(self, rows: pd.DataFrame) -> None:
        """Every row draws a number, and those with the lowest numbers stay."""
        rows = rows.assign(_drawn=self._rng.uniform(size=len(rows)))
        rows = rows if self._rows is None else pd.concat([self._rows, rows], ignore_index=True)
        self._rows = rows.nsmallest(self.size, "_drawn").reset_index(drop=True)

    @property
    def table(self) -> pd.DataFrame:
        """The sample, in random order."""
        return pd.DataFrame() if self._rows is None else self._rows.drop(columns="_drawn")


def quality(data: list[pd.DataFrame]) -> list[float]:
    """Mean return of the episodes that each model's transitions come from."""
    return [float(rows["return"].mean()) for rows in data]


def model_file(args: argparse.Namespace, variant: str) -> Path:
    """Where the models of a variant are stored."""
    return Path(args.out) / f"models-{variant}.safetensors"


def fit_piece(
    args: argparse.Namespace, ses: Any, data: list[pd.DataFrame], pieces: common.Pieces
) -> pd.DataFrame:
    """Fits all models, stores both variants of them, and returns the errors of each epoch."""
    num_rows = min(len(rows) for rows in data)
    settings = {"proxy": vars(ses.config.proxy), "models": args.models, "num_rows": num_rows,
                "epochs": args.epochs, "learning_rate": LEARNING_RATE, "batch_size": BATCH_SIZE,
                "generations": args.generations, "population": args.population,
                "seed": args.seed}  # fmt: skip
    fits = pieces.compute("fit", settings, lambda: fit_all(args, ses, data, num_rows))
    last = fits[fits["epoch"] == args.epochs - 1].mean()
    print(f"Models: mean squared error {last['error']:.2g} of [s', r], "
          f"{last['done_error']:.2g} of the end", flush=True)  # fmt: skip
    return fits


def fit_all(
    args: argparse.Namespace, ses: Any, data: list[pd.DataFrame], num_rows: int
) -> pd.DataFrame:
    """Fits a model to each run's transitions and writes the models; a row for each epoch."""
    import jax

    from sejax.parallel import spread_over_devices

    arrays = [arrays_of(rows.iloc[:num_rows]) for rows in data]
    stacked = tuple(np.stack(parts) for parts in zip(*arrays, strict=True))
    keys = jax.random.split(jax.random.key(args.seed), args.models)
    fit = make_fit(ses.env, num_rows, args.epochs)
    program = jax.jit(spread_over_devices(fit, args.devices))
    initial, fitted, errors = jax.device_get(program(keys, *stacked))
    save_models(args, ses, {**fitted, "done": initial["done"]}, "authors", "soft")
    save_models(args, ses, fitted, "fair", "threshold")
    return pd.concat([
        pd.DataFrame({"model": i, "epoch": range(args.epochs), "error": errors[i, :, 0],
                      "done_error": errors[i, :, 1]})
        for i in range(args.models)
    ])  # fmt: skip


def arrays_of(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States `[n, obs_dim]`, actions `[n]`, targets [s', r] and ends `[n]`."""
    states = [name for name in rows if name.startswith("state_")]
    targets = [name for name in rows if name.startswith("next_state_")] + ["reward"]
    return (
        rows[states].to_numpy(np.float32),
        rows["action"].to_numpy(np.int32),
        rows[targets].to_numpy(np.float32),
        rows["terminated"].to_numpy(np.float32),
    )


def make_fit(env: Any, num_rows: int, epochs: int) -> Callable[..., Any]:
    """Builds `fit(key, states, actions, targets, ends) -> (initial, fitted, errors [epochs, 2])`.

    The errors are means over an epoch, of [s', r] and of the end. What does not fill the last batch
    of an epoch is left out of it; the order is drawn anew for each.
    """
    import jax
    import jax.numpy as jnp
    import optax

    batch_size = min(BATCH_SIZE, num_rows)
    num_batches = num_rows // batch_size
    optimizer = optax.adam(LEARNING_RATE)

    def errors_of(weights: Any, states: Any, actions: Any, targets: Any, ends: Any) -> Any:
        state, reward, done = jax.vmap(env.predict, (None, 0, 0))(weights, states, actions)
        predicted = jnp.concatenate([state, reward[:, None]], axis=1)
        return jnp.stack([jnp.mean((predicted - targets) ** 2), jnp.mean((done - ends) ** 2)])

    def loss(weights: Any, batch: Any) -> Any:
        errors = errors_of(weights, *batch)
        return errors.sum(), errors

    def fit(key: Any, *data: Any) -> Any:
        key_init, key_order = jax.random.split(key)
        initial = env.init_weights(key_init)
        data = tuple(map(jnp.asarray, data))

        def update(carry: Any, rows: Any) -> Any:
            weights, opt_state = carry
            batch = tuple(x[rows] for x in data)
            gradient, errors = jax.grad(loss, has_aux=True)(weights, batch)
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


def save_models(args: argparse.Namespace, ses: Any, weights: Any, variant: str, done: str) -> None:
    """Stores the models of a variant, as SEs with their use of the done output."""
    import jax

    from sejax.proxies.sets import save_set

    config = dataclasses.replace(ses.config, proxy=dataclasses.replace(ses.config.proxy, done=done))
    each = [jax.tree.map(lambda x, i=i: x[i], weights) for i in range(args.models)]
    seeds = [args.seed + i for i in range(args.models)]
    save_set(model_file(args, variant), config, each, [float("nan")] * args.models,
             [args.generations] * args.models, seeds)  # fmt: skip
