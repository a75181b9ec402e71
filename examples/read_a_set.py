"""Reading a set of proxies, and training agents on each of them in one compiled program.

    python read_a_set.py                                  # learns four proxies first
    python read_a_set.py SET.safetensors                  # one of those in results/ of sejax

The first takes 12 seconds on four cores; there is a line for each proxy:

    seed 0, learned with 0.99: 50 fresh agents return 0.97, deviation 0.15

Proxies of a set share their shapes and hence every program: their weights are an array's axis.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import sejax

AGENT = sejax.QLearningConfig()
ES = sejax.NESConfig(population_size=16, num_incumbent_evals=16, noise_std=0.1, noise_std_decay=1)


def learn_a_set(path: Path, size: int, generations: int) -> None:
    """Learns synthetic environments of a small grid from several seeds at once."""
    task = sejax.envs.make("gridworld_2x2")
    proxy = sejax.SyntheticConfig(hidden_size=16, initial_state="real", horizon=None).make(task)
    agent = sejax.make_agent(AGENT, task)
    learn = sejax.make_learner(
        task=task, agent=agent, proxy=proxy, es=ES, devices=1,
        training=sejax.TrainingConfig(max_steps=1000, stop_rule="never"), generations=generations,
    )  # fmt: skip
    results = jax.device_get(jax.jit(jax.vmap(learn))(jax.random.split(jax.random.key(0), size)))
    weights = [jax.tree.map(lambda x, i=i: x[i], results.weights) for i in range(size)]
    records = [{"seed": i, "score": float(x)} for i, x in enumerate(results.score)]
    sejax.save_set(path, proxy, weights, records)


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains agents on each proxy of a set.")
    parser.add_argument("path", type=Path, nargs="?", default=Path("my_set.safetensors"))
    parser.add_argument("--agents", type=int, default=50, help="on each proxy")
    parser.add_argument("--size", type=int, default=4, help="of the set, if it must be learned")
    parser.add_argument("--generations", type=int, default=20, help="in which it is learned")
    args = parser.parse_args()
    sejax.configure_xla()  # a device for each core
    if not args.path.exists():
        learn_a_set(args.path, args.size, args.generations)
    proxies = sejax.load_set(args.path)
    is_told = "training" in proxies.config  # as in those of results/
    agent = sejax.agent_of(proxies) if is_told else sejax.make_agent(AGENT, proxies.task)
    training = sejax.training_of(proxies) if is_told else sejax.TrainingConfig(max_steps=1000)
    evaluate = sejax.make_evaluator(agent, proxies.env, proxies.task, training)

    def train_and_test(key: jax.Array, weights: object) -> sejax.Outcome:
        return evaluate(key, proxies.env.params(weights, proxies.discount))

    number = np.repeat(np.arange(len(proxies)), args.agents)  # of each agent's proxy
    keys = jax.random.split(jax.random.key(1), number.size)
    weights = jax.tree.map(lambda x: x[number], proxies.weights)
    num_parallel = agent.spec.cpu_num_parallel
    program = sejax.spread_over_devices(train_and_test, cpu_num_parallel=num_parallel)
    outcome = jax.jit(program)(keys, weights)
    returns = np.asarray(outcome.test_return).reshape(len(proxies), args.agents)
    for record, mine in zip(proxies.records, returns, strict=True):
        print(f"seed {record['seed']}, learned with {record['score']:.2f}: {args.agents} fresh "
              f"agents return {mine.mean():.2f}, deviation {mine.std():.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
