"""sejax's agents beside those of Stable-Baselines3 and rejax, with equal settings on real tasks.

Networks, batches, rates, targets, noise, random first steps and the number of steps are equal, but
that rejax's SAC has no random ones; an off-policy agent learns once in each step. What stays as a
library has it: initial weights, the order of an update's parts, and in Stable-Baselines3 the Huber
loss of DQN. An agent plays ten greedy episodes after its last step.

At a time limit Stable-Baselines3 bootstraps and rejax does not. sejax's agents train both ways, and
each library is compared with the way that is its own. Of rejax there are the agents whose settings
can be equal: its PPO clips values, and its TD3 follows both critics.

It needs `pip install 'sejax[examples]'`.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import sejax
from experiments.common import figures, tables
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.statistics import difference_interval
from sejax.envs import with_one_done
from sejax.envs.wrappers import repeat_actions
from sejax.evaluation import make_fixed, make_tester
from sejax.gym import GYMNASIUM_IDS
from sejax.options import Count
from sejax.options.plain import configure, to_plain

TEST_EPISODES = 10
SIZES = {"hidden_size": 64, "num_layers": 2}  # as rejax's DQN has them
OFF_POLICY = SIZES | {"batch_size": 64, "buffer_size": 20_000, "learning_rate": 1e-3, "tau": 0.01}
PPO = SIZES | {"learning_rate": 1e-3, "clip_ratio": 0.2, "gae_lambda": 0.95, "init_action_std": 1.0}
# Of a task: agents, their decisions and PPO's, the random episodes before off-policy agents learn,
# the decisions that these usually take, and the steps of the task in each decision.
DISCRETE, CONTINUOUS = ("dqn", "ddqn", "td3_discrete", "sac", "ppo"), ("td3", "sac", "ppo")
TASKS = {
    "cartpole": (DISCRETE, 10_000, 20_480, 10, 223, 1),
    "acrobot": (DISCRETE, 20_000, 20_480, 1, 500, 1),
    "pendulum": (CONTINUOUS, 8_000, 40_960, 5, 1_000, 1),
    "mountain_car_continuous": (CONTINUOUS, 6_000, 6_144, 5, 1_000, 5),
}
LIBRARIES = {  # what they are called, and their colour in the figure
    "sejax": ("sejax", figures.REAL),
    "sb3": ("SB3", figures.VARIED),
    "terminal": ("sejax, limit terminal", figures.TUNED),
    "rejax": ("rejax", figures.FIXED),
}
PAIRS = {"sb3": "sejax", "rejax": "terminal"}  # what each is compared with


@dataclass(frozen=True, kw_only=True)
class Agents(Settings):
    """Settings of this experiment.

    Attributes:
      tasks: to train on
      libraries: sejax, sb3, terminal (sejax without a bootstrap at the time limit), rejax
      num_agents: of each library, agent and task
      num_torch_agents: of those, with Stable-Baselines3
      steps: decisions of each training; by task and agent
    """

    name = "agents"

    tasks: tuple[str, ...] = setting(tuple(TASKS), TASKS, quick=("cartpole",))
    libraries: tuple[str, ...] = setting(tuple(LIBRARIES), LIBRARIES, quick=("sejax", "terminal"))
    num_agents: Count = setting(20, quick=2)
    num_torch_agents: Count = setting(20, quick=2)
    steps: Count | None = setting(None, quick=512)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """An agent on a task, for a number of decisions."""

    task: str
    agent: str
    steps: int

    @functools.cached_property
    def real(self) -> sejax.Task:
        """The task."""
        return sejax.envs.make(self.task)

    @functools.cached_property
    def config(self) -> Any:
        """The hyperparameters, as sejax has them."""
        *_, random_episodes, _, action_repeat = TASKS[self.task]
        values: dict[str, Any] = dict(PPO if self.agent == "ppo" else OFF_POLICY)
        if self.agent != "ppo":
            values["warmup_episodes"] = random_episodes
        elif self.task == "pendulum":
            values |= {"discount": 0.9, "entropy_weight": 0.0}
        if self.agent in ("dqn", "ddqn"):
            values |= {"epsilon_min": 0.05, "exploration_steps": self.steps // 10}
        else:
            values["action_repeat"] = action_repeat
        return configure("agent", values | {"name": self.agent})

    def options(self, names: dict[str, str]) -> dict[str, Any]:
        """The hyperparameters as another library calls them: its own name, or `THEIRS=OURS`."""
        kinds = ("all", self.agent, "all" if self.agent == "ppo" else "off_policy")
        words = " ".join(names.get(kind, "") for kind in kinds).split()
        pairs = [word.partition("=") for word in words]
        return {theirs: getattr(self.config, ours or theirs) for theirs, _, ours in pairs}

    @property
    def exploration(self) -> float:
        """The share of the training after which epsilon has fallen."""
        return (TASKS[self.task][4] + self.config.exploration_steps) / self.steps


def cells_of(library: str, settings: Agents) -> list[Cell]:
    """The agents of a library on each task."""
    chosen = []
    for task in settings.tasks:
        agents, steps, ppo_steps, *_ = TASKS[task]
        in_sb3 = ("dqn", "ppo") if agents == DISCRETE else CONTINUOUS
        known = {"sejax": agents, "sb3": in_sb3}.get(library, ("dqn", "ddqn", "sac"))
        for agent in sorted({*agents} & {*known}, key=agents.index):
            usual = ppo_steps if agent == "ppo" else steps
            chosen.append(Cell(task=task, agent=agent, steps=settings.steps or usual))
    return chosen


# --- the libraries -------------------------------------------------------------------------------

Train = Callable[[int], float]  # of a seed: the mean return of the tests


def train_sejax(cell: Cell, limit_is_terminal: bool = False) -> Train:
    training = sejax.TrainingConfig(
        max_steps=cell.steps * TASKS[cell.task][5],
        max_episodes=cell.steps,
        test_episodes=TEST_EPISODES,
        time_limit_is_terminal=limit_is_terminal,
    )
    task, agent = cell.real, sejax.make_agent(cell.config, cell.real)
    run = jax.jit(sejax.make_evaluator(agent, task.env, task, training))
    return lambda seed: float(run(jax.random.key(seed), task.params).test_returns.mean())


SB3 = {
    "all": "learning_rate gamma=discount",
    "off_policy": "buffer_size batch_size tau",
    "dqn": "exploration_final_eps=epsilon_min",
    "td3": "policy_delay target_policy_noise=target_noise_std target_noise_clip",
    "ppo": "n_steps=rollout_steps n_epochs=epochs gae_lambda clip_range=clip_ratio max_grad_norm "
    "ent_coef=entropy_weight vf_coef=value_weight",
}


class Repeated(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A task of Gymnasium whose actions are repeated, as by sejax's `ActionRepeat`."""

    def __init__(self, cell: Cell):
        limit = cell.real.max_steps
        super().__init__(gymnasium.make(GYMNASIUM_IDS[cell.task], max_episode_steps=limit))
        self.num_repeats = TASKS[cell.task][5]

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        total = 0.0
        for _ in range(self.num_repeats):
            obs, reward, terminated, truncated, info = super().step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return obs, total, terminated, truncated, info


def train_sb3(cell: Cell) -> Train:
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    config, options = cell.config, cell.options(SB3) | {"device": "cpu"}
    activation = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[config.activation]
    layers = [config.hidden_size] * config.num_layers
    networks: dict[str, Any] = {"net_arch": layers, "activation_fn": activation}
    if cell.agent == "ppo":
        networks["log_std_init"] = np.log(config.init_action_std)
        options["batch_size"] = config.rollout_steps // config.num_minibatches
    else:
        options |= {"learning_starts": TASKS[cell.task][4], "train_freq": 1, "gradient_steps": 1}
    if cell.agent == "dqn":
        options |= {"exploration_fraction": cell.exploration, "target_update_interval": 1}
        options["max_grad_norm"] = np.inf
    if cell.agent == "td3":
        std = np.full(cell.real.action_dim, config.action_noise_std)
        options["action_noise"] = NormalActionNoise(0 * std, std)

    def train(seed: int) -> float:
        make = functools.partial(make_vec_env, lambda: Repeated(cell))
        env: Any = make(seed=seed)
        if cell.agent == "ppo":
            env = VecNormalize(env, norm_obs=False, clip_reward=np.inf, gamma=config.discount)
        algorithm = getattr(sb3, cell.agent.upper())
        model = algorithm("MlpPolicy", env, seed=seed, policy_kwargs=networks, **options)
        model.learn(cell.steps)
        return float(evaluate_policy(model, make(seed=seed + 10_000), TEST_EPISODES)[0])

    return train


REJAX = {
    "all": "learning_rate gamma=discount",
    "off_policy": "buffer_size batch_size",
    "dqn": "eps_end=epsilon_min ddqn=double",
    "ddqn": "eps_end=epsilon_min ddqn=double",
}


def train_rejax(cell: Cell) -> Train:
    import rejax

    config, task, options = cell.config, cell.real, cell.options(REJAX)
    options |= {"num_envs": 1, "total_timesteps": cell.steps, "eval_freq": cell.steps}
    options |= {"polyak": 1 - config.tau, "fill_buffer": TASKS[cell.task][4]}
    options["agent_kwargs"] = {"activation": config.activation}
    if cell.agent != "sac":
        options["exploration_fraction"] = cell.exploration
    elif task.num_actions is not None:
        options["target_entropy_ratio"] = config.target_entropy_fraction
    env = repeat_actions(task.env, TASKS[cell.task][5])
    algorithm = (rejax.SAC if cell.agent == "sac" else rejax.DQN).create(
        env=with_one_done(env), skip_initial_evaluation=True, **options
    )
    algorithm = algorithm.replace(eval_callback=lambda *_: jnp.zeros(()))

    def best(key: Any, params: Any, obs: Any) -> Any:
        """The action without exploration."""
        if cell.agent != "sac":
            return jnp.argmax(algorithm.agent.apply(params, obs[None])[0])
        mode = algorithm.actor.apply(params, obs[None], method="_action_dist").mode()[0]
        return mode if task.num_actions is not None else task.max_action * jnp.tanh(mode)

    test = make_tester(make_fixed(task, best), task, TEST_EPISODES, lambda _: env)

    @jax.jit
    def run(key: Any) -> Any:
        key_train, key_test = jax.random.split(key)
        state, _ = algorithm.train(key_train)
        trained = state.actor_ts if cell.agent == "sac" else state.q_ts
        return test(key_test, trained.params).returns.mean()

    return lambda seed: float(run(jax.random.key(seed)))


TRAINERS: dict[str, Callable[[Cell], Train]] = {
    "sejax": train_sejax,
    "sb3": train_sb3,
    "terminal": functools.partial(train_sejax, limit_is_terminal=True),
    "rejax": train_rejax,
}


# --- rows and report -----------------------------------------------------------------------------


def compute(settings: Agents) -> pd.DataFrame:
    """Trains what is missing; a row for each agent, which is kept as soon as it is trained."""
    rows = []
    for library in settings.libraries:
        number = settings.num_torch_agents if library == "sb3" else settings.num_agents
        for cell in cells_of(library, settings):
            columns = {"task": cell.task, "agent": cell.agent, "steps": cell.steps}
            made_with = columns | {"library": library, "random_steps": TASKS[cell.task][4]}
            made_with["agent"] = to_plain(cell.config, "agent")
            train = functools.cache(functools.partial(TRAINERS[library], cell))
            for seed in range(settings.seed, settings.seed + number):
                name = f"{cell.task}-{cell.agent}-{library}-{seed:04d}"
                one = functools.partial(row_of, train, seed)
                row = settings.shards.compute(name, made_with | {"seed": seed}, one)
                rows.append(row.assign(**columns, library=library))
            print(f"{library}: {cell}: done", flush=True)
    return pd.concat(rows, ignore_index=True)


def row_of(make: Callable[[], Train], seed: int) -> pd.DataFrame:
    """The row of an agent, which trains here."""
    return pd.DataFrame([{"test_return": make()(seed)}])


def compare(rows: pd.DataFrame) -> dict[str, float]:
    """Means and numbers of each library's agents, and by how much sejax leads."""
    returns = {library: rows[rows["library"] == library]["test_return"] for library in LIBRARIES}
    columns: dict[str, float] = {}
    for library, scores in returns.items():
        columns |= {f"{library}_mean": scores.mean(), f"{library}_agents": len(scores)}
    for library, ours in PAIRS.items():
        low, high = difference_interval(returns[ours], returns[library])
        lead = returns[ours].mean() - returns[library].mean()
        columns |= {f"{library}_lead": lead, f"{library}_low": low, f"{library}_high": high}
    return columns


def report(settings: Agents, rows: pd.DataFrame) -> pd.DataFrame:
    summary = tables.summary_by(rows, ["task", "agent", "steps"], compare)
    draw(settings, rows)
    columns: dict[str, Any] = {"task": "{task}", "steps": "{steps:,}"}
    columns["agent"] = lambda row: figures.agent_name(row.agent)
    for library, ours in PAIRS.items():
        for name in (ours, library):
            columns[LIBRARIES[name][0]] = f"{{{name}_mean:.1f}} ({{{name}_agents}})"
        title = f"{LIBRARIES[ours][0]} - {LIBRARIES[library][0]}"
        columns[title] = f"{{{library}_lead:.1f}} [{{{library}_low:.1f}}, {{{library}_high:.1f}}]"
    table = tables.as_texts(summary, columns).replace(r".*\bnan\b.*", "", regex=True)
    note = (
        f"Mean return of {TEST_EPISODES} greedy episodes after the last step (agents); of the "
        "difference Welch's 95% interval over agents."
    )
    return tables.publish(settings, "Agents of three libraries", table, summary, note)


def draw(settings: Agents, rows: pd.DataFrame) -> None:
    """Each agent's return as a dot, and means as lines; a panel for each task."""
    tasks = rows["task"].unique()
    size = 3.4 * len(tasks), 3.6
    with figures.panels(settings.folder / "agents.png", 1, len(tasks), size) as (figure, axes):
        for axis, task in zip(axes[0], tasks, strict=True):
            agents = [agent for agent in TASKS[task][0] if agent in set(rows["agent"])]
            for i, (library, (label, color)) in enumerate(LIBRARIES.items()):
                cells = rows[(rows["task"] == task) & (rows["library"] == library)]
                places = cells["agent"].map(agents.index) + 0.2 * (i - 1.5)
                axis.plot(places, cells["test_return"], ".", color=color, alpha=0.4)
                means = cells["test_return"].groupby(places).mean()
                axis.plot(means.index, means, "_", color=color, ms=11, mew=2.5, label=label)
            axis.set_xticks(range(len(agents)), map(figures.agent_name, agents), fontsize=8)
            axis.set_title(task, fontsize=10)
        figures.legend_above(figure, axes[0, 0])


EXPERIMENT = Experiment(settings=Agents, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
