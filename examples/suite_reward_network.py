"""A reward network for a task of another suite, and fresh agents that learn with it and without it.

    pip install 'sejax[stoa]' navix
    python suite_reward_network.py stoa/navix/Navix-Empty-5x5-v0 --solved=0.9

Any `env` will do: `stoa/SUITE/ID`, or `gymnax/ID`, which needs no further package. Every agent
trains until it has solved the task or has made all its steps.
"""

import argparse

import jax

import sejax


def main() -> None:
    parser = argparse.ArgumentParser(description="Learns an RN of any JAX environment.")
    parser.add_argument("env", nargs="?", default="stoa/navix/Navix-Empty-5x5-v0")
    parser.add_argument("--solved", type=float, default=0.9, help="return that counts as solved")
    parser.add_argument("--steps", type=int, default=20_000, help="of each training, at most")
    parser.add_argument("--generations", type=int, default=10)
    parser.add_argument("--population", type=int, default=8)
    parser.add_argument("--agents", type=int, default=8, help="fresh ones, with and without the RN")
    args = parser.parse_args()
    sejax.configure_xla()  # a device for each core
    config = sejax.config([
        f"env={args.env}", f"env.solved_reward={args.solved}", "proxy=rn", "agent=ppo",
        f"generations={args.generations}", f"es.population_size={args.population}",
        f"training.max_steps={args.steps}", f"training.max_episodes={args.steps}",
        "training.stop_rule=solved",
    ])  # fmt: skip
    parts = config.parts()
    task, agent, training = parts["task"], parts["agent"], parts["training"]
    learned = jax.jit(sejax.make_learner(**parts, generations=args.generations))(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), args.agents)
    for name, env, params in (
        ("with the RN", parts["proxy"], parts["proxy"].params(learned.weights)),
        ("without it", task.env, task.params),
    ):
        outcome = sejax.evaluate_agents(agent, env, params, task, training, keys)
        solved = (outcome.test_return >= task.solved_reward).sum()
        print(f"{name}: {solved} of {args.agents} agents solve {args.env}, after "
              f"{outcome.train_steps.mean():,.0f} steps; mean return "
              f"{outcome.test_return.mean():.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
