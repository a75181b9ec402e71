"""CPU time of one agent step for each family of agents on one core: sejax against eager PyTorch.

Each family trains `--agents` agents for `--steps` steps on a fresh SE of the paper's kind, soft and
with the task's step limit. Hyperparameters are the paper's: for DDQN those of CartPole, with the SE
of its table, for PPO `preset=paper` of MountainCarContinuous' RNs, for the others the defaults.
DDQN, which PyTorch trains too, and PPO are measured at those of `preset=best` as well, where
networks and batches are small. Agents learn from the first step on; training never stops early, and
a fresh SE hardly ever ends an episode. PPO learns when its rollout is full: it trains for a
multiple of that many steps, at least two, so that acting and learning have their usual shares.

sejax trains the agents as the commands do, through `spread_over_devices` and with the agent's own
number of agents in parallel, but on one device. PyTorch trains `--torch-agents` of them one after
the other, for as many steps each: what a step costs there does not depend on how many there are.

Both sides are kept to the same core and take turns, so that a disturbance meets both. Compilation
is not counted, nor is a short training by PyTorch before the first. CPU time, unlike wall-clock,
excludes what other processes take. The ratio of a pair is what to quote: PyTorch's time over
sejax's.
"""

import argparse
import functools
import os
from dataclasses import dataclass, replace
from typing import Any

import common

import sejax
from sejax.options.plain import configure
from sejax.proxies import ProxyConfig
from sejax.training import TrainingConfig

WARM_UP_STEPS = 300


@dataclass(frozen=True, kw_only=True)
class Family:
    """A row of the table.

    Attributes:
      agent: name of the agent.
      env: name of the task that the SE stands in for.
      in_torch: whether `torch_reference.py` has the agent too.
      settings: "paper" or "best": whose hyperparameters.
    """

    agent: str
    env: str
    in_torch: bool = False
    settings: str = "paper"

    def parts(self, steps: int) -> tuple[Any, ProxyConfig, TrainingConfig]:
        """Configurations of agent and SE, and a training of `steps` in which the agent learns.

        PPO trains for whole learning phases, at least two of them.
        """
        of_paper = {"initial_state": "real", "horizon": None, "done": "soft"}
        proxy = configure("proxy", {"name": "se", **of_paper})
        if self.settings == "best" or self.agent == "ddqn":
            names = f"env={self.env}", f"agent={self.agent}", f"preset={self.settings}"
            chosen = sejax.config(names)
            agent = chosen.agent
            if self.settings == "paper":
                proxy = chosen.proxy
        elif self.agent == "ppo":
            words = "env=mountain_car_continuous", "proxy=rn", "agent=ppo", "preset=paper"
            agent = replace(sejax.config(words).agent, action_repeat=1)
        else:
            agent = configure("agent", {"name": self.agent, **PAPERS.get(self.agent, {})})
        agent = replace(agent, warmup_episodes=0)
        limit = configure("env", {"name": self.env}).spec.max_steps
        phase = agent.steps_before_learning(limit, limit)  # 0 but for PPO
        steps = max(2, -(-steps // phase)) * phase if phase else steps
        training = TrainingConfig(stop_rule="never", max_steps=steps, max_episodes=steps)
        return agent, proxy, training


_LAYERS = {"hidden_size": 128, "num_layers": 2}
PAPERS: dict[str, dict[str, Any]] = {  # the paper's default agents
    "dueling_ddqn": _LAYERS
    | {"batch_size": 128, "exploration_steps": None, "feature_dim": 128, "stream_hidden_size": 128},
    "td3_discrete": _LAYERS | {"batch_size": 128, "learning_rate": 5e-4},
    "td3": _LAYERS | {"batch_size": 256, "learning_rate": 3e-4, "tau": 0.005},
}
FAMILIES = {
    f"{family.agent}, {family.settings}": family
    for family in [
        Family(agent="ddqn", env="cartpole", in_torch=True),
        Family(agent="ddqn", env="cartpole", in_torch=True, settings="best"),
        Family(agent="td3", env="pendulum"),
        Family(agent="td3", env="pendulum", settings="best"),
        Family(agent="ppo", env="cartpole"),
        Family(agent="ppo", env="cartpole", settings="best"),
        Family(agent="dueling_ddqn", env="cartpole"),
        Family(agent="td3_discrete", env="cartpole"),
        Family(agent="q_learning", env="cliff_walking"),
        Family(agent="sarsa", env="cliff_walking"),
    ]
}


# Name of an option -> value if --quick, value otherwise, what it counts.
SIZES = {
    "agents": (3, 40, "that sejax trains in each family"),
    "torch_agents": (1, 3, "that PyTorch trains"),
    "steps": (300, 2000, "of each agent"),
    "pairs": (3, 3, "repetitions"),
}


def main() -> None:
    """Runs the benchmark, or one of its sides."""
    args = common.parse_args(__doc__, add_options)
    for name, (quick, full, _) in SIZES.items():
        if getattr(args, name) is None:
            setattr(args, name, quick if args.quick else full)
    if args.side:
        os.sched_setaffinity(0, {args.core})
        SIDES[args.side](args)
        return
    names = args.families or list(FAMILIES)[: 2 if args.quick else None]
    machine = common.machine()
    answers = measure_pairs(args, names)
    rows = {name: common.compare_with_torch(mine) for name, mine in answers.items()}
    share = common.share_of_core([*answers.values()])
    common.show_comparison(f", {args.agents} agents", "agent, hyperparameters", rows, share)
    settings = {name: getattr(args, name) for name in (*SIZES, "core")}
    families = {name: row | {"steps": answers[name]["sejax"][0]["steps"]}
                for name, row in rows.items()}  # fmt: skip
    result = {"families": families, "share_of_core": share}
    common.finish("agent_families", args, {"machine": machine, "settings": settings, **result})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this benchmark."""
    for name, (quick, full, text) in SIZES.items():
        values = f"{text} ({quick} if --quick, else {full})"
        parser.add_argument(common.option(name), type=int, help=values)
    parser.add_argument(
        "--families", nargs="+", choices=FAMILIES, metavar="FAMILY",
        help="rows of the table, such as 'td3, paper' (the first two if --quick, else all)",
    )  # fmt: skip
    common.add_core(parser)


def measure_pairs(args: argparse.Namespace, names: list[str]) -> dict[str, common.Answers]:
    """What both sides answer about each family."""
    options = {x: getattr(args, x) for x in ("agents", "torch_agents", "steps", "core", "seed")}
    answers = {}
    with common.sides_of(__file__, common.PAIR, **options) as sides:
        for name in names:
            in_torch = FAMILIES[name].in_torch
            mine = sides if in_torch else {"sejax": sides["sejax"]}
            weights = sides["sejax"].ask(family=name)["weights"]
            if in_torch:
                sides["torch"].ask(family=name, weights=weights)
            requests = [{"family": name, "seed": args.seed + pair} for pair in range(args.pairs)]
            answers[name] = common.in_turns(mine, requests, warm_up=False)
    return answers


def sejax_side(args: argparse.Namespace) -> None:
    """Trains all agents of a family in one program for one device.

    A request without a seed compiles that, and answers with the SE's weights.
    """
    from sejax.runs.runtime import configure_jax, configure_xla

    configure_xla(1)
    configure_jax()
    import jax
    import numpy as np

    from sejax.ops.parallel import spread_over_devices

    programs = {}

    def keys(seed: int) -> jax.Array:
        return jax.random.split(jax.random.key(seed), args.agents)

    def prepare(family: str) -> dict[str, Any]:
        agent_config, proxy_config, training = FAMILIES[family].parts(args.steps)
        task = sejax.envs.make(FAMILIES[family].env)
        env, agent = proxy_config.make(task), sejax.make_agent(agent_config, task)
        train = sejax.make_trainer(agent, env, training)
        weights = env.init_weights(jax.random.key(args.seed))

        def train_all(keys: jax.Array, params: Any) -> Any:
            one = functools.partial(train, env_params=params)
            return spread_over_devices(one, cpu_num_parallel=agent.spec.cpu_num_parallel)(keys)

        params = env.params(weights)
        programs[family] = jax.jit(train_all).lower(keys(0), params).compile(), params
        return {"weights": jax.tree.map(lambda x: np.asarray(x).tolist(), weights)}

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        if "seed" not in request:
            return prepare(request["family"])
        program, params = programs[request["family"]]
        chosen = keys(request["seed"])
        result, times = common.measure(lambda: jax.block_until_ready(program(chosen, params)))
        return {"steps": int(result.train_steps.sum()), **times}

    common.serve({}, handle)


def torch_side(args: argparse.Namespace) -> None:
    """Trains some agents of a family one after the other with one thread.

    A request with weights makes the SE of them and trains an agent for a few steps.
    """
    import torch
    from torch_reference import SyntheticEnv, train

    torch.set_num_threads(1)
    prepared = {}

    def prepare(family: str, weights: Any) -> dict[str, Any]:
        agent, proxy, training = FAMILIES[family].parts(args.steps)
        env = SyntheticEnv(weights, proxy)
        prepared[family] = functools.partial(train, env, agent, training)
        train(env, agent, FAMILIES[family].parts(WARM_UP_STEPS)[2], 0)
        return {}

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        if "weights" in request:
            return prepare(request["family"], request["weights"])
        first = request["seed"] * args.torch_agents
        seeds, run = range(first, first + args.torch_agents), prepared[request["family"]]
        results, times = common.measure(lambda: [run(seed) for seed in seeds])
        return {"steps": sum(result.train_steps for result in results), **times}

    common.serve({}, handle)


SIDES = {"sejax": sejax_side, "torch": torch_side}

if __name__ == "__main__":
    main()
