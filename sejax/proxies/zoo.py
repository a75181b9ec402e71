"""The proxies that ship with the package, model cards, and sharing on the Hugging Face Hub.

All of it reads a file's header without JAX. `tools/ship_proxy.py` writes the shipped files,
`tools/make_zoo.py` makes `docs/zoo.md` of them.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sejax.options import registry
from sejax.options.plain import from_plain
from sejax.proxies import header, hub
from sejax.proxies.configs import SyntheticConfig

SHIPPED_LICENSE = "Apache-2.0, like sejax, which made it; it contains no data of others."


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Fresh agents of one kind, all trained in one environment and tested on the real task.

    Attributes:
      agent: name of the kind, such as `ddqn`.
      hparams: default, varied (drawn for each agent) or as_learned (those it was learned with).
      world: where they trained: proxy, or real, the task itself.
      num_agents: number of agents.
      return_mean: mean of the agents' mean test returns, in the task's unit.
      return_std: standard deviation of the same.
      train_steps: mean number of training steps of an agent.
    """

    agent: str
    hparams: str
    world: str
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
      agents: number of agents that were trained.
      train_steps: steps of their trainings, which for an SE are none of the real task.
      real_steps: steps on the real task, tests included.
      cpu_s: CPU seconds, compilation included.
    """

    command: str
    generations: int
    agents: int
    train_steps: int
    real_steps: int
    cpu_s: float


@dataclass(frozen=True, kw_only=True)
class PretrainedProxy:
    """What a proxy's file tells about it.

    Attributes:
      name: name that `sejax.load` knows it by.
      kind: se, rn, or the name of another configuration.
      task: name of the task that it stands in for.
      settings: the proxy's configuration, plain values.
      scores: mean score of the incumbent with each agent that it was learned with, in the
        generation that the proxy is of; for an SE a test return. Empty if it was not recorded.
      objective: name of the objective that the scores are of; "" if it was not recorded.
      generation: generation that the proxy is of; None if it was not recorded.
      seed: seed of its run; None if it was not recorded.
      evaluations: results of fresh agents.
      learning: its run; None if it was not recorded.
      size_kb: size of the file in units of 1,000 bytes.
    """

    name: str
    kind: str
    task: str
    settings: dict[str, Any]
    scores: dict[str, float]
    objective: str
    generation: int | None
    seed: int | None
    evaluations: tuple[Evaluation, ...]
    learning: Learning | None
    size_kb: float

    @property
    def agents(self) -> tuple[str, ...]:
        """The agents that it was learned with."""
        return tuple(self.scores)

    @property
    def on_proxy(self) -> tuple[Evaluation, ...]:
        """The evaluations of agents that trained on it, and not on the real task."""
        return tuple(each for each in self.evaluations if each.world == "proxy")

    @property
    def card(self) -> str:
        """The model card, in Markdown."""
        return card_of(self, self.name, (), SHIPPED_LICENSE)

    @property
    def row(self) -> dict[str, str]:
        """The cells of a table of proxies, by the names of their columns."""
        learning = self.learning
        return {
            "name": self.name,
            "kind": self.kind,
            "task": self.task,
            "learned with": ", ".join(self.agents),
            "tested with": ", ".join(dict.fromkeys(each.agent for each in self.on_proxy)),
            "return": spread([each.return_mean for each in self.on_proxy], ".1f"),
            "steps": spread([each.train_steps for each in self.on_proxy], ",.0f"),
            "CPU s": f"{learning.cpu_s:,.0f}" if learning else "",
            "real steps": f"{learning.real_steps:,}" if learning else "",
            "kB": f"{self.size_kb:.1f}",
        }


class Zoo(tuple[PretrainedProxy, ...]):
    """Proxies, which print as a table."""

    def __repr__(self) -> str:
        rows = [proxy.row for proxy in self]
        table = [list(rows[0]), *(list(row.values()) for row in rows)] if rows else []
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = (
            "  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)) for row in table
        )
        return "\n".join(map(str.rstrip, lines))


def pretrained() -> Zoo:
    """The proxies that ship with the package, by name; `sejax.load(name)` loads one.

    Example:
      >>> [proxy.name for proxy in pretrained() if proxy.kind == "se"][:2]
      ['acrobot', 'cartpole']
    """
    names = header.pretrained_names()
    return Zoo(describe(header.PRETRAINED_DIR / f"{name}.safetensors") for name in names)


def describe(path: Path, name: str | None = None) -> PretrainedProxy:
    """What a file of one proxy tells about it.

    Args:
      path: the file.
      name: name of the proxy; the file's if None.

    Raises:
      ConfigError: if it is damaged, of another format, or a set.
    """
    _, stored = header.read_single(path)
    record = stored.proxies[0]
    scores = record.get("scores")
    if scores is None:
        scores = dict.fromkeys(stored.agents, record["score"]) if "score" in record else {}
    learning = record.get("learning")
    return PretrainedProxy(
        name=name or path.stem,
        kind=stored.kind,
        task=stored.task,
        settings=stored.config["proxy"],
        scores=scores,
        objective=str((stored.config.get("objective") or {}).get("name", "")),
        generation=record.get("generation"),
        seed=record.get("seed"),
        evaluations=tuple(
            from_plain(Evaluation, each, "evaluation") for each in record.get("evaluations", ())
        ),
        learning=from_plain(Learning, learning, "learning") if learning else None,
        size_kb=path.stat().st_size / 1000,
    )


def spread(values: Sequence[float], spec: str) -> str:
    """The lowest and the highest of some numbers; nothing if there are none.

    Example:
      >>> spread([199.5, 180.0], ".1f"), spread([4000.0, 4000.2], ",.0f")
      ('180.0 to 199.5', '4,000')
    """
    ends = [format(end(values), spec) for end in (min, max)] if values else []
    return " to ".join(text for text, _ in itertools.groupby(ends))


# --- model cards ----------------------------------------------------------------------------------

_ABOUT = {
    "se": "A synthetic environment (SE) for the task `{task}`: small networks make its states and "
    "rewards. Agents train on it alone, without a step of the real task, and are then used there. "
    "Its states and rewards need not be like the real ones.",
    "rn": "A reward network (RN) for the task `{task}`: the dynamics are the real task's, and a "
    "small network makes the reward, so that agents like those it was learned with need fewer real "
    "steps. It may not help other agents, or may harm them.",
}
_ABOUT_OTHER = "A proxy for the task `{task}`, of its author's own kind `{kind}`."
_STARTS = {
    "real": "the real task's",
    "learned": "made by a network from noise",
    "noise": "standard normal noise",
}
_ENDS = {
    "threshold": "where the done output exceeds 1/2",
    "bernoulli": "with the probability that the done output is",
    "sigmoid": "with the probability that the done output's sigmoid is",
    "soft": 'where the done output exceeds 1/2; agents must bootstrap with `info["discount"]`',
}
_SCORES = {"reward_threshold": "minus the training steps until solved, and a penalty if unsolved"}
_HPARAMS = {"default": "default", "varied": "drawn for each", "as_learned": "as it was learned"}
_WORLDS = {"proxy": "this proxy", "real": "the real task"}


def card_of(proxy: PretrainedProxy, source: str, needs: Sequence[str], license_text: str) -> str:
    """A proxy's model card, in Markdown; it leaves out what is not known.

    Args:
      proxy: what its file tells.
      source: what `sejax.load` takes.
      needs: the arguments that `sejax.load` needs beside it (`task`, `proxy`), because a file's
        names are never imported.
      license_text: a sentence, or the license's name.
    """
    about = _ABOUT.get(proxy.kind, _ABOUT_OTHER).format(task=proxy.task, kind=proxy.kind)
    facts = table(["property", "value"], list(_facts(proxy).items()))
    parts = [f"# {proxy.name}", about, facts]
    if proxy.evaluations:
        rows = [
            (
                each.agent,
                _HPARAMS[each.hparams],
                _WORLDS[each.world],
                f"{each.return_mean:.1f} ± {each.return_std:.1f}",
                f"{each.train_steps:,.0f}",
                str(each.num_agents),
            )
            for each in proxy.evaluations
        ]
        columns = ["agent", "hyperparameters", "trained on", "return", "training steps", "agents"]
        parts += [
            "## What it teaches",
            "Fresh agents, trained for the steps given and then tested on the real task (mean and "
            "standard deviation of the agents' mean returns):",
            table(columns, rows),
        ]
    if proxy.learning:
        parts += ["## How it was learned", f"    {proxy.learning.command}"]
    usage = _usage(proxy, source, needs)
    return "\n\n".join([*parts, "## How to use it", usage, "## License", license_text])


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _facts(proxy: PretrainedProxy) -> dict[str, str]:
    """What is known of a proxy's episodes and of how it was learned, by property."""
    facts = {}
    if proxy.kind == "se":
        config: SyntheticConfig = registry.configure("proxy", proxy.settings)
        limit = f"at most {config.horizon} steps" if config.horizon else "the real task's limit"
        facts["initial states"] = _STARTS[config.initial_state]
        facts["episodes"] = "one step: a contextual bandit" if config.is_bandit else limit
        if not config.is_bandit:
            facts["an episode ends"] = _ENDS[config.done]
    if proxy.scores:
        meaning = _SCORES.get(proxy.objective)
        facts["agents"] = ", ".join(proxy.agents)
        facts["score"] = ", ".join(f"{agent} {x:.1f}" for agent, x in proxy.scores.items())
        facts["score"] += f" ({meaning})" if meaning else ""
    for name, number in (("generation", proxy.generation), ("seed", proxy.seed)):
        facts |= {} if number is None else {name: str(number)}
    if proxy.learning:
        learning = proxy.learning
        facts["cost of the run"] = (
            f"{learning.cpu_s:,.0f} CPU seconds, {learning.generations} generations, "
            f"{learning.agents:,} agents, {learning.train_steps:,} training steps"
        )
        only = " (all of them tests)" if proxy.kind == "se" else ""
        facts["steps on the real task"] = f"{learning.real_steps:,}{only}"
    return facts


def _usage(proxy: PretrainedProxy, source: str, needs: Sequence[str]) -> str:
    """Calls and the command that use a proxy."""
    options = {"task": "env", "proxy": "proxy_kind"}  # of commands, for arguments of `sejax.load`
    call = f'("{source}"' + "".join(f", {name}=..." for name in needs) + ")"
    words = "".join(f" {options[name]}=..." for name in needs) + _words_of_best(proxy)
    install = "With `pip install 'sejax[hub]'`:\n\n" if hub.is_address(source) else ""
    gym = f"env = sejax.gym.make{call}  # a gymnasium.Env, in NumPy: any agent, no JAX\n"
    return (
        f"{install}```python\nimport sejax\n\n{gym if proxy.kind == 'se' else ''}"
        f"env, params = sejax.load{call}  # a gymnax environment, in JAX\n```\n\n"
        f"`python -m sejax.evaluate proxy={source}{words}` trains agents on it and tests them on "
        f"the real task."
    )


def _words_of_best(proxy: PretrainedProxy) -> str:
    """Overrides of `sejax.evaluate` that train the agents which learned best."""
    best = max(proxy.on_proxy, key=lambda each: each.return_mean, default=None)
    if best is None:
        return ""
    if best.hparams == "as_learned":
        known = [name for name in proxy.agents if registry.is_registered("agent", name)]
        # An agent that is solved for on an SE cannot train on the real task beside it.
        is_alone = any(registry.find("agent", name).is_solved_for for name in known)
        return " agent_hparams=as_learned" + (" baseline=false" if is_alone else "")
    varied = " agent_hparams=varied" if best.hparams == "varied" else ""
    return f" agent={best.agent}{varied}"


# --- sharing --------------------------------------------------------------------------------------

_TAGS = {"se": ["synthetic-environment"], "rn": ["reward-network"]}


def push(
    source: str | Path,
    repo: str,
    *,
    private: bool = False,
    license: str = "apache-2.0",
    message: str = "A proxy of sejax",
) -> str:
    """Puts a proxy on the Hugging Face Hub, from where `sejax.load("hf://USER/REPO")` loads it.

    Writes `proxy.safetensors` and its card, `README.md`, in one commit. Needs the extra `hub`, and
    a token that may write (`hf auth login`).

    Args:
      source: one proxy, as of `sejax.load`.
      repo: `USER/REPO`; made if it is not there.
      private: whether a new repository is private.
      license: name by which the Hub knows it; that of the shipped proxies if not given.
      message: message of the commit.

    Returns:
      Its address, which `sejax.load` takes.

    Raises:
      ConfigError: if there is no such proxy, it is a set, or the repository cannot be written.
    """
    hub.require_repo(repo)
    path = header.find(source)
    proxy = describe(path, name=repo.rpartition("/")[2])
    config = header.read_config(path)
    needs = [
        argument
        for group, argument in (("env", "task"), ("proxy", "proxy"))
        if not header.is_registered(group, config[group])
    ]
    address = f"{hub.SCHEME}{repo}"
    card = _front_matter(proxy, license) + card_of(proxy, address, needs, license)
    hub.upload(repo, {hub.FILE: path.read_bytes(), "README.md": card.encode()}, message, private)
    return address


def _front_matter(proxy: PretrainedProxy, license: str) -> str:
    """What the Hub itself reads of a card, in YAML."""
    values: Mapping[str, Any] = {
        "library_name": "sejax",
        "license": license,
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "jax", *_TAGS.get(proxy.kind, []), proxy.task],
    }
    return f"---\n{yaml.safe_dump(values, sort_keys=False)}---\n\n"
