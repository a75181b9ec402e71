"""What agents with the settings of `preset=best` know of the real task after a few thousand steps.

    python benchmarks/short_budgets.py
    python benchmarks/short_budgets.py --env pendulum --agent sac --seeds 3

Prints a row for each agent: the mean over seeds of greedy test returns after each budget, below it
the worst seed's, and CPU microseconds of a step, tests included, on one core. Agents bootstrap at
time limits. Nothing here belongs to an SE: it is how its agents' settings were chosen.
"""

import argparse
import time

import jax
import numpy as np

import sejax
from sejax import plugins
from sejax.app import presets

BUDGETS = (2000, 5000, 10_000, 20_000)
ROWS = {
    "cartpole": ("ddqn", "dqn", "sac", "td3_discrete"),
    "acrobot": ("ddqn", "dqn", "sac"),
    "pendulum": ("td3", "sac"),
    "mountain_car_continuous": ("td3", "sac"),
}


def preset_options(env: str, agent: str) -> dict[str, object]:
    """The agent's options for SEs of this task."""
    for preset, _, choice, values in presets.settings(env, "se"):
        if preset == "best" and choice == agent:
            return values["agent"]
    return {}


def measure(env: str, agent: str, num_seeds: int) -> tuple[np.ndarray, float]:
    """Test returns `[budget, seed]`, and CPU microseconds of a training step."""
    task = sejax.envs.make(env)
    config = plugins.configure("agent", {"name": agent, **preset_options(env, agent)})
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
    parser.add_argument("--env", choices=ROWS)
    parser.add_argument("--agent")
    parser.add_argument("--seeds", type=int, default=10)
    args = parser.parse_args()
    print("| task | agent |", " | ".join(f"{x:,} steps" for x in BUDGETS), "| us a step |")
    print("| --- | --- |" + " --- |" * (len(BUDGETS) + 1))
    for env, agents in ROWS.items():
        for agent in agents:
            if args.env in (None, env) and args.agent in (None, agent):
                returns, cost = measure(env, agent, args.seeds)
                cells = [f"{x.mean():.1f} ({x.min():.0f})" for x in returns]
                print(f"| {env} | {agent} |", " | ".join(cells), f"| {cost:.1f} |", flush=True)


if __name__ == "__main__":
    main()
