"""What small and quick agents know of the real task after a few thousand steps.

    python benchmarks/short_budgets.py
    python benchmarks/short_budgets.py --env pendulum --agent sac --seeds 3

Prints a row for each agent: the mean over seeds of greedy test returns after each budget, below it
the worst seed's, and CPU microseconds of a step, tests included, on one core. Agents bootstrap at
time limits. There is no SE here: this is how settings of agents for short budgets were chosen.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np

import sejax
from sejax.options import registry

BUDGETS = (2000, 5000, 10_000, 20_000)
SMALL = {"warmup_episodes": 1, "batch_size": 64, "hidden_size": 64, "num_layers": 1}
BY_STEPS = {"exploration_steps": 1000, "epsilon_min": 0.05}
QUICK = {"learning_rate": 3e-3, "tau": 0.05}
SAC_PENDULUM = {"activation": "fast_tanh", "learning_rate": 0.01, "discount": 0.98}
TD3_PENDULUM = {"warmup_episodes": 3, "learning_rate": 5e-3, "tau": 0.01,
                "discount": 0.98}  # fmt: skip
# Exploration is all that is hard there: random episodes, repeated actions, and an entropy near that
# of uniform ones.
SAC_CAR = {"warmup_episodes": 4, "activation": "fast_tanh", "learning_rate": 0.01,
           "tau": 0.02, "target_entropy": 0.5, "action_repeat": 8}  # fmt: skip
# Task, agent, options beside `SMALL`.
ROWS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("cartpole", "ddqn", {}),
    ("cartpole", "ddqn", BY_STEPS),
    ("cartpole", "dqn", {"tau": 0.02}),
    ("cartpole", "sac", QUICK),
    ("cartpole", "td3_discrete", {**QUICK, "one_hot_actions": True}),
    ("acrobot", "ddqn", BY_STEPS),
    ("acrobot", "dqn", {"tau": 0.02}),
    ("acrobot", "sac", QUICK),
    ("pendulum", "sac", SAC_PENDULUM),
    ("pendulum", "td3", TD3_PENDULUM),
    ("mountain_car_continuous", "sac", SAC_CAR),
)
ENVS = tuple(dict.fromkeys(env for env, _, _ in ROWS))


def measure(
    env: str, agent: str, options: dict[str, Any], num_seeds: int
) -> tuple[np.ndarray, float]:
    """Test returns `[budget, seed]`, and CPU microseconds of a training step."""
    task = sejax.envs.make(env)
    config = registry.configure("agent", {"name": agent, **SMALL, **options})
    made = sejax.make_agent(config, task)
    keys = jax.random.split(jax.random.key(0), num_seeds)
    returns, seconds, steps = [], 0.0, 0
    for budget in BUDGETS:
        training = sejax.TrainingConfig(
            max_episodes=budget, max_steps=budget, stop_rule="never", time_limit_is_terminal=False
        )
        evaluate = sejax.make_evaluator(made, task.env, task, training)

        def one_by_one(keys, evaluate=evaluate, params=task.params):
            return jax.lax.map(lambda key: evaluate(key, params), keys)

        program = jax.jit(one_by_one).lower(keys).compile()
        started = time.process_time()
        outcome = jax.block_until_ready(program(keys))
        seconds += time.process_time() - started
        steps += int(outcome.train_steps.sum())
        returns.append(outcome.test_returns.mean(axis=-1))
    return np.array(returns), 1e6 * seconds / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--env", choices=ENVS)
    parser.add_argument("--agent")
    parser.add_argument("--seeds", type=int, default=10)
    args = parser.parse_args()
    print("| task | agent |", " | ".join(f"{x:,} steps" for x in BUDGETS), "| us a step |")
    print("| --- | --- |" + " --- |" * (len(BUDGETS) + 1))
    for env, agent, options in ROWS:
        if args.env in (None, env) and args.agent in (None, agent):
            returns, cost = measure(env, agent, options, args.seeds)
            cells = [f"{x.mean():.1f} ({x.min():.0f})" for x in returns]
            said = ", ".join(f"{name} {value}" for name, value in options.items())
            print(f"| {env} | {agent}{said and ': ' + said} |", " | ".join(cells),
                  f"| {cost:.1f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
