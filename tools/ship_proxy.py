"""Puts a learned proxy into the package, with how it was learned, what it teaches, and its card.

    python tools/ship_proxy.py runs/cartpole-se-ddqn+ppo-s1 cartpole --agents ddqn,ppo,sac
    python tools/ship_proxy.py runs/cliff_walking-rn-q_learning-s0 cliff_walking-rn --agents q_learning
    python tools/ship_proxy.py rns/additive_potential.safetensors#3 cartpole-rn --hparams as_learned

Fresh agents of each kind train on it and are tested on the real task (`python -m sejax.evaluate`),
with each choice of hyperparameters. What it cost is in the run directory; of a bare file nothing is
known. Writes `sejax/pretrained/NAME.safetensors`; afterwards `python tools/make_zoo.py` makes
docs/zoo.md anew.
"""  # noqa: E501

import argparse
import dataclasses
import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import yaml

import sejax
from sejax.cli import build
from sejax.proxies import card, files, zoo
from sejax.serialize import flatten

FREE_FIELDS = ("run_dir", "devices", "checkpoint_every")  # how to compute, not what
WORLDS = {"the proxy": "proxy", "the real task": "real"}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", help="run directory or file of the proxy, or SET#PLACE")
    parser.add_argument("name", help="what sejax.load will call it")
    parser.add_argument("overrides", nargs="*", help="of sejax.evaluate, such as seed=1")
    parser.add_argument("--agents", type=lambda text: text.split(","), default=["ddqn"],
                        help="kinds of agents, such as ddqn,ppo,sac")  # fmt: skip
    parser.add_argument("--num-agents", type=int, default=20, help="of each kind")
    parser.add_argument("--hparams", type=lambda text: text.split(","), default=["default"],
                        help="theirs: some of default,varied,as_learned")  # fmt: skip
    parser.add_argument("--baseline", action="store_true", help="as many on the real task")
    parser.add_argument("--out", type=Path, default=files.PRETRAINED_DIR, help="folder; sejax's")
    args = parser.parse_intermixed_args()  # overrides may come after options
    path, _, place = args.run.partition("#")
    proxy = files.load_set(path, option="run").select([int(place or 0)])
    more = learning_of(Path(path))
    with tempfile.TemporaryDirectory() as folder:
        alone = Path(folder) / f"{args.name}.safetensors"
        save(alone, proxy)
        more["evaluations"] = [
            dataclasses.asdict(each)
            for hparams in args.hparams
            for each in evaluate(alone, hparams, args.agents, args.num_agents, args.baseline,
                                 args.overrides)
        ]  # fmt: skip
        save(alone, proxy, **more)
        more["card"] = card.card_of(zoo.describe(alone))
    target = args.out / f"{args.name}.safetensors"
    save(target, proxy, **more)
    print(f"{more['card']}\n{zoo.Zoo([zoo.describe(target)])}\n\n{target}")


def save(path: Path, proxy: files.ProxySet, **more: object) -> None:
    """Writes a set of one as a single proxy, with more in its record."""
    record = {**proxy.records[0], **more}
    config = {**proxy.config, "seed": record.get("seed"), "num_seeds": 1}
    weights = jax.tree.map(lambda x: x[0], proxy.weights)
    files.save(path, proxy.env, weights, config, proxy.discount, **record)


# --- how it was learned --------------------------------------------------------------------------


def learning_of(path: Path) -> dict[str, Any]:
    """What a run directory says of its run, as a part of the proxy's record."""
    if not path.is_dir():
        return {}
    ended = json.loads((path / "run.json").read_text())  # not there before the run has ended
    config = yaml.safe_load((path / "config.yaml").read_text())
    costs = {name: ended[name] for name in ("generations", "agents", "train_steps", "real_steps",
                                            "cpu_s")}  # fmt: skip
    command = f"python -m sejax.run {shlex.join(words_of(config))}"
    return {"learning": dataclasses.asdict(zoo.Learning(command=command, **costs))}


def words_of(config: Mapping[str, Any]) -> list[str]:
    """The shortest words that compose a run's configuration; its place and devices apart."""
    families = {key: each for key, each in (config["agents"] or {}).items()
                if isinstance(each, Mapping)}  # fmt: skip
    names = ",".join(each["name"] for each in families.values())
    agents = f"agents=[{names}]" if families else f"agent={config['agent']['name']}"
    groups = ("proxy", "exploration", "es", "objective")
    words = [f"env={config['env']['name']}", f"preset={config['preset']}", agents,
             *(f"{group}={config[group]['name']}" for group in groups)]  # fmt: skip
    words += differing(words, config)
    assert not differing(words, config), f"the configuration is not that of {words}"
    for word in words[1:]:  # those that say what is so anyway
        rest = [other for other in words if other != word]
        words = words if differing(rest, config) else rest
    return words


def differing(words: list[str], config: Mapping[str, Any]) -> list[str]:
    """The fields, as words with their values, in which what these words compose is another run."""
    try:
        composed = flatten(json.loads(json.dumps(build.to_plain(sejax.config(words)))))
    except sejax.ConfigError as error:  # without the word that a field belongs to
        return [str(error)]
    return [f"{name}={_as_word(value)}" for name, value in flatten(config).items()
            if composed.get(name) != value and name not in FREE_FIELDS]  # fmt: skip


def _as_word(value: Any) -> str:
    """A value as the command line takes it."""
    return json.dumps(value, separators=(",", ":")) if not isinstance(value, str) else value


# --- what it teaches -----------------------------------------------------------------------------


def evaluate(
    path: Path, hparams: str, agents: list[str], num_agents: int, baseline: bool,
    overrides: list[str],
) -> list[zoo.Evaluation]:  # fmt: skip
    """What `python -m sejax.evaluate` says of a proxy."""
    if hparams == "as_learned":
        agents, choice = list(files.load_proxy(path).learned_agents()), []
    else:
        choice = [f"agent=[{','.join(agents)}]"]
    command = [sys.executable, "-m", "sejax.evaluate", f"proxy={path}", f"num_agents={num_agents}",
               f"agent_hparams={hparams}", f"baseline={str(baseline).lower()}",
               f"out_dir={path.parent}", *choice, *overrides]  # fmt: skip
    subprocess.run(command, check=True)
    summary = json.loads((path.parent / "evaluation.json").read_text())
    return [
        zoo.Evaluation(
            agent=agent, hparams=hparams, world=WORLDS[world], num_agents=row["num_agents"],
            return_mean=row["test_return_mean"], return_std=row["test_return_std"],
            train_steps=row["train_steps_mean"],
        )
        for world, rows in summary.items()
        for agent, row in (rows if len(agents) > 1 else {agents[0]: rows}).items()
    ]  # fmt: skip


if __name__ == "__main__":
    main()
