"""What the experiments with SEs share: their agents, and the worlds that these are trained in."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import pandas as pd

from experiments.settings import Settings, count, each_of, setting
from experiments.worlds import World, groups_at_once, train_groups, training_as_learned
from sejax import registry
from sejax.options import counts

AGENTS = ("ddqn", "dueling_ddqn", "td3_discrete")

# Hidden sizes up to 6: one network has room for all of them, and little is compiled.
QUICK_AGENT: Any = {"hidden_size": 2, "batch_size": 16, "num_layers": 1, "warmup_episodes": 1}
QUICK_STEPS = 1500

SOFT_SE = "results/soft_ses/cartpole.safetensors"  # with dynamics to look into, as the paper's


@dataclass(frozen=True, kw_only=True)
class SeAgents(Settings):
    """Settings about agents with drawn hyperparameters that are trained on the SEs of a set."""

    agents: tuple[str, ...] = setting(AGENTS, each_of(AGENTS), about="kinds of agents")
    num_agents: int = count(10, "agents", quick=4, about="for each SE")
    num_ses: int = count(40, "SEs", quick=3, about="SEs of a set at most")
    test_episodes: int = count(10, "episodes", about="of each agent")
    max_steps: int | None = setting(
        None,
        counts("an agent must train"),
        quick=4000,
        about="training steps at most; as the SEs' own configuration says",
    )


def agent_config(settings: Settings, kind: str) -> Any:
    """The configuration of a kind of agent."""
    changes = QUICK_AGENT if settings.quick else {}
    return registry.configure("agent", {"name": kind, **changes})


def se_world(settings: SeAgents, ses: Any, kind: str) -> World:
    """The SEs of a set; agents train as long as those that the SEs were learned with."""
    agent = agent_config(settings, kind)
    learned = training_as_learned(ses, agent)
    limits = [x for x in (learned.max_steps, settings.max_steps) if x is not None]
    training = dataclasses.replace(
        learned, max_steps=min(limits, default=None), test_episodes=settings.test_episodes
    )
    # The weights' hash is in the name, so that sets can share a folder: se_models then finds those
    # of se_performance.
    names = [f"se-{seed:02d}-{ses.fingerprint(i)}" for i, seed in enumerate(ses.seeds)]
    return World.of_set(ses, names, name=kind, agent=agent, training=training, hparams="varied")


def train(settings: SeAgents, world: World) -> pd.DataFrame:
    """All agents of a world, a row each."""
    rows = train_groups(
        world, settings, settings.num_agents, at_once=groups_at_once(settings.devices)
    )
    return rows.assign(kind=world.name)
