"""The proxies that ship with the package, model cards, and sharing on the Hugging Face Hub.

This module reads the headers of files. `tools/ship_proxy.py` writes the shipped files, and
`tools/make_zoo.py` makes `docs/zoo.md` of them.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from sejax.options import escaped, require
from sejax.options.plain import defaults_of, from_plain, to_plain
from sejax.proxies import header, hub

CARD = Path(__file__).with_name("card.md")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Fresh agents of one kind, all trained in one environment and tested on the real task.

    Attributes:
      agent: name of the kind, such as `ddqn`.
      hparams: default, varied (drawn for each agent) or as_learned (those it was learned with).
      world: where the agents trained: proxy, or real, the task itself.
      num_agents: number of agents.
      return_mean: mean of the agents' mean test returns, in the task's unit.
      return_std: standard deviation of the same.
      train_steps: mean number of training steps of an agent.
    """

    agent: str
    hparams: Literal["default", "varied", "as_learned"]
    world: Literal["proxy", "real"]
    num_agents: int
    return_mean: float
    return_std: float
    train_steps: float


@dataclass(frozen=True, kw_only=True)
class Learning:
    """The run that a proxy comes from, and the cost of the whole run.

    Attributes:
      command: command that repeats it.
      generations: generations of the outer loop.
      real_steps: steps on the real task, tests included.
      agents: number of agents that were trained; None if not recorded.
      train_steps: training steps of these agents, which for an SE are not steps of the real task;
        None if not recorded.
      cpu_s: CPU seconds, compilation included; None if not recorded.
    """

    command: str
    generations: int
    real_steps: int
    agents: int | None = None
    train_steps: int | None = None
    cpu_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class PretrainedProxy:
    """What a proxy's file tells about it.

    Attributes:
      name: name that `sejax.load` knows it by.
      kind: se, rn, or the name of another configuration.
      task: name of the task that it stands in for.
      settings: the proxy's configuration, plain values.
      scores: mean score of the incumbent with each agent that it was learned with, in the proxy's
        generation; for an SE a test return. Empty if not recorded.
      objective: name of the scores' objective; "" if not recorded.
      generation: generation that the proxy comes from; None if not recorded.
      seed: seed of its run; None if not recorded.
      evaluations: results of fresh agents.
      learning: its run; None if not recorded.
      policy_return: return of the policy that it was made of; None if it was learned with agents.
      needs: groups (`env`, `proxy`) whose configuration must be given to `sejax.load`, because a
        file's names are never imported.
    """

    name: str
    kind: str
    task: str
    settings: dict[str, Any] = field(repr=False)
    scores: dict[str, float] = field(default_factory=dict)
    objective: str = ""
    generation: int | None = None
    seed: int | None = None
    evaluations: tuple[Evaluation, ...] = field(default=(), repr=False)
    learning: Learning | None = field(default=None, repr=False)
    policy_return: float | None = None
    needs: tuple[str, ...] = ()

    @property
    def on_proxy(self) -> tuple[Evaluation, ...]:
        """The evaluations of agents that trained on it, and not on the real task."""
        return tuple(x for x in self.evaluations if x.world == "proxy")

    @property
    def card(self) -> str:
        """The model card, in Markdown."""
        return card_of(self, self.name)


def pretrained() -> tuple[PretrainedProxy, ...]:
    """The proxies that ship with the package, by name; `sejax.load(name)` loads one.

    Example:
      >>> [proxy.name for proxy in pretrained() if proxy.kind == "se"][:2]
      ['acrobot', 'acrobot-distilled']
    """
    files = header.pretrained_files().values()
    return tuple(describe(header.read(file, single=True)) for file in files)


def describe(stored: header.Stored, name: str | None = None) -> PretrainedProxy:
    """What a file of one proxy tells about it.

    Args:
      stored: the file.
      name: name of the proxy; the file's if None.

    Raises:
      ConfigError: for an evaluation or a learning of another shape.
    """
    path, _, learned = stored
    record = learned.proxies[0]
    config = learned.config
    values = {x: record[x] for x in defaults_of(PretrainedProxy) if record.get(x) is not None}
    if "score" in record:
        values.setdefault("scores", dict.fromkeys(config["agents"], float(record["score"])))
    objective = config.get("objective")
    values |= {
        "name": name or path.stem,
        "kind": learned.kind,
        "task": learned.task,
        "settings": config["proxy"],
        "objective": objective.get("name", "") if isinstance(objective, Mapping) else "",
        "needs": [x for x in header.GIVEN if not header.is_known(x, config[x])],
    }
    return from_plain(PretrainedProxy, values, "record")


# --- model cards ----------------------------------------------------------------------------------

_KINDS = {"se": ["synthetic-environment"], "rn": ["reward-network"], "other": []}  # with tags
_FACTS = ("settings", "scores", "objective", "generation", "seed", "learning", "policy_return")
_ROW = (  # of an evaluation
    "| {0.agent} | {0.hparams} | {0.world} | {0.return_mean:.1f} ± {0.return_std:.1f} | "
    "{0.train_steps:,.0f} | {0.num_agents} |"
)


def card_of(proxy: PretrainedProxy, source: str, license: str = "") -> str:
    """A proxy's model card: `card.md` filled with its values. Parts without values are left out.

    Args:
      proxy: what its file tells.
      source: what `sejax.load` takes. For an address on the Hub the card gets front matter.
      license: name of the license; by default that of the shipped proxies.
    """
    kind = proxy.kind if proxy.kind in _KINDS else "other"
    given = [header.GIVEN[group] for group in proxy.needs]
    call = ", ".join([f'"{source}"', *(f"{argument}=..." for argument, _ in given)])
    words = "".join(f" {word}=..." for _, word in given)
    gym = f"env = sejax.gym.make({call})  # a gymnasium.Env, in NumPy: any agent\n"
    best = max(proxy.on_proxy, key=lambda evaluation: evaluation.return_mean, default=None)
    if best and best.hparams != "as_learned":
        words += f" agent={best.agent}"
    if best and best.hparams != "default":
        words += f" agent_hparams={best.hparams}"
    plain = to_plain(proxy)
    if proxy.learning:
        plain["learning"].pop("command")  # the card shows it below
    facts = {name: plain[name] for name in _FACTS if plain[name] not in (None, "", {})}
    values = {x: escaped(vars(proxy)[x]) for x in ("name", "kind", "task")} | {
        "front": json.dumps(license) if source.startswith(hub.SCHEME) else None,
        "tags": json.dumps(["reinforcement-learning", "jax", *_KINDS[kind], proxy.task]),
        **{name: "" if name == kind else None for name in _KINDS},
        "facts": yaml.safe_dump(facts, sort_keys=False).rstrip(),
        "evaluations": "\n".join(escaped(_ROW.format(x)) for x in proxy.evaluations) or None,
        "command": proxy.learning and escaped(proxy.learning.command),
        "install": "With `pip install 'sejax[hub]'`:\n\n" if source.startswith(hub.SCHEME) else "",
        "gym": gym if kind == "se" else "",
        "call": call,
        "source": source,
        "overrides": escaped(words),
        "license": license
        or "Apache-2.0, like sejax, which made it; it contains no data of others.",
    }
    parts = CARD.read_text(encoding="utf-8").rstrip().split("\n\n\n")
    kept = [x for x in parts if None not in map(values.get, re.findall(r"\{(\w+)\}", x))]
    return "\n\n".join(kept).format(**values)


# --- sharing --------------------------------------------------------------------------------------


def push(
    source: str | Path, repo: str, *, private: bool = False, license: str = "apache-2.0"
) -> str:
    """Puts a proxy on the Hugging Face Hub, from where `sejax.load("hf://USER/REPO")` loads it.

    Writes `proxy.safetensors` and its card, `README.md`, in one commit. Needs the extra `hub`, and
    a token that may write (`hf auth login`).

    Args:
      source: one proxy, as in `sejax.load`.
      repo: `USER/REPO`; made if it is not there.
      private: whether a new repository is private.
      license: the Hub's name of the license; by default that of the shipped proxies.

    Returns:
      Its address, which `sejax.load` takes.

    Raises:
      ConfigError: if there is no such proxy, it is a set, or the repository cannot be written.
    """
    stored = header.read(source, single=True)
    rule = "must be USER/REPO on the Hub"
    require(str(repo).count("/") == 1, "repo", rule, got=repo)
    address = f"{hub.SCHEME}{repo}"
    require(hub.parse(address, "repo")[0] == repo, "repo", rule, got=repo)
    card = card_of(describe(stored, repo.rpartition("/")[2]), address, license)
    with hub.explained("repo", repo):
        from huggingface_hub import CommitOperationAdd, HfApi

        HfApi().create_repo(repo, private=private, exist_ok=True)
        files = {hub.FILE: stored.path.read_bytes(), "README.md": card.encode()}
        additions = [CommitOperationAdd(name, content) for name, content in files.items()]
        HfApi().create_commit(repo, additions, commit_message="A proxy of sejax")
    return address
