"""Puts a learned proxy into the package, with how it was learned and what it teaches.

    python tools/ship_proxy.py runs/cartpole-se-ddqn+ppo-s1 cartpole --agents ddqn,ppo,sac
    python tools/ship_proxy.py runs/cliff_walking-rn-q_learning-s0 cliff_walking-rn --agents q_learning
    python tools/ship_proxy.py rns/additive_potential.safetensors#3 cartpole-rn --hparams as_learned

Fresh agents of each kind train on it and are tested on the real task (`python -m sejax.evaluate`),
with each choice of hyperparameters. The run directory tells what learning it cost; the curves beside
a set of `experiments/` tell the real steps; a bare file tells nothing. Writes
`sejax/pretrained/NAME.safetensors`; then `python tools/make_zoo.py` makes docs/zoo.md.
"""  # noqa: E501

import argparse
import dataclasses
import itertools
import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

import sejax
from sejax.options.plain import flatten
from sejax.proxies import header, zoo
from sejax.runs.config import LearnConfig

FREE_FIELDS = ("run_dir", "devices", "checkpoint_every")  # how to compute, not what
COSTS = ("generations", "agents", "train_steps", "real_steps", "cpu_s")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", help="run directory or file of the proxy, or SET#PLACE")
    parser.add_argument("name", help="what sejax.load will call it")
    parser.add_argument("overrides", nargs="*", help="of sejax.evaluate, such as num_agents=50")
    parser.add_argument("--agents", default="ddqn", help="kinds of agents, such as ddqn,ppo,sac")
    parser.add_argument("--hparams", default="default", help="of default,varied,as_learned")
    parser.add_argument("--out", type=Path, default=header.PRETRAINED_DIR, help="folder; sejax's")
    args = parser.parse_intermixed_args()  # overrides may come after options
    path, _, number = args.run.partition("#")
    proxy = sejax.load_set(path, option="run")[int(number or 0)]
    more = learning_of(Path(path), proxy)
    with tempfile.TemporaryDirectory() as folder:
        alone = Path(folder) / f"{args.name}.safetensors"
        save(alone, proxy)
        evaluated = [evaluate(alone, hparams, args) for hparams in args.hparams.split(",")]
    target = args.out / f"{args.name}.safetensors"
    save(target, proxy, **more, evaluations=[*itertools.chain(*evaluated)])
    shipped = zoo.describe(header.read(target))
    print(f"{shipped.card}\n\n{target}")


def save(path: Path, proxy: sejax.Proxy, **more: object) -> None:
    """Writes a proxy with more in its record."""
    record = {**proxy.record, **more}
    config = {**proxy.config, "seed": record.get("seed")}
    sejax.save(path, proxy.env, proxy.params.weights, config, proxy.discount, **record)


# --- how it was learned ---------------------------------------------------------------------------


def learning_of(path: Path, proxy: sejax.Proxy) -> dict[str, Any]:
    """What is known of a proxy's run, as a part of its record."""
    curves = path.with_name("curves.csv.xz")
    if path.is_dir():
        ended = json.loads((path / "run.json").read_text())  # not there before the run has ended
        stored = yaml.safe_load((path / "config.yaml").read_text())
        config = LearnConfig.of_stored(stored).plain()
        costs = {name: ended[name] for name in COSTS}
    elif curves.exists():
        learned = LearnConfig.of_stored(proxy.config)  # with the names of today
        config = json.loads(json.dumps(learned.plain()))
        config["seed"] = proxy.record["seed"]
        rows = pd.read_csv(curves).query("variant == @path.stem and seed == @config['seed']")
        costs = {"generations": len(rows), "real_steps": int(rows["env_steps_total"].max())}
    else:
        return {}
    command = f"python -m sejax.run {shlex.join(words_of(config))}"
    learning = zoo.Learning(command=command, **costs)
    return {"learning": dataclasses.asdict(learning)}


def words_of(config: Mapping[str, Any]) -> list[str]:
    """The shortest overrides that compose a run's configuration, but for its place and devices."""
    names = [each["name"] for each in config["agents"].values() if isinstance(each, Mapping)]
    agents = f"agents=[{','.join(names)}]" if len(names) > 1 else f"agent={names[0]}"
    groups = ("proxy", "exploration", "es", "objective")
    words = [f"env={config['env']['name']}", f"preset={config['preset']}", agents]
    words += [f"{group}={config[group]['name']}" for group in groups]
    words += differing(words, config)
    assert not differing(words, config), f"the configuration is not that of {words}"
    for word in words[1:]:  # those that say what is so anyway
        rest = [other for other in words if other != word]
        words = words if differing(rest, config) else rest
    return words


def differing(words: list[str], config: Mapping[str, Any]) -> list[str]:
    """The fields, as overrides, in which what these words compose is another run."""
    try:
        composed = flatten(json.loads(json.dumps(sejax.config(words).plain())))
    except sejax.ConfigError as error:  # without the word that a field belongs to
        return [str(error)]
    texts = {name: x if isinstance(x, str) else json.dumps(x, separators=(",", ":"))
             for name, x in flatten(config).items()
             if composed.get(name) != x and name not in FREE_FIELDS}  # fmt: skip
    return [f"{name}={text}" for name, text in texts.items()]


# --- what it teaches ------------------------------------------------------------------------------


def evaluate(path: Path, hparams: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Results of `python -m sejax.evaluate` on a proxy, as `zoo.Evaluation` has them."""
    choice = [f"agents=[{args.agents}]" if "," in args.agents else f"agent={args.agents}"]
    if hparams == "as_learned":
        choice = []
    words = [f"proxy={path}", "num_agents=20", f"agent_hparams={hparams}", "baseline=false"]
    words += [f"out_dir={path.parent}", *choice, *args.overrides]
    subprocess.run([sys.executable, "-m", "sejax.evaluate", *words], check=True)
    worlds = {"the proxy": "proxy", "the real task": "real"}
    columns = {"return_mean": "test_return_mean", "return_std": "test_return_std"}
    columns |= {"num_agents": "num_agents", "train_steps": "train_steps_mean"}
    return [
        {"agent": agent, "hparams": hparams, "world": worlds[world]}
        | {name: row[column] for name, column in columns.items()}
        for world, rows in json.loads((path.parent / "evaluation.json").read_text()).items()
        for agent, row in rows.items()
    ]


if __name__ == "__main__":
    main()
