"""Puts a learned proxy into the package, with the numbers of its evaluation in its metadata.

    python benchmarks/ship_proxy.py runs/cartpole-se-ddqn-s1 cartpole
    python benchmarks/ship_proxy.py runs/cliff_walking-rn-q_learning-s0 cliff_walking-rn \\
        agent=q_learning
    python benchmarks/ship_proxy.py rns/additive_potential.safetensors#3 cartpole-rn

Runs `python -m sejax.evaluate` on it (fresh agents with the paper's default hyperparameters, and as
many on the real task) and writes `sejax/pretrained/NAME.safetensors`.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import common

from sejax.proxies import io
from sejax.proxies.sets import load_set


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", help="run directory or file of the proxy, or SET#PLACE")
    parser.add_argument("name", help="what sejax.load will call it")
    parser.add_argument("overrides", nargs="*", help="of sejax.evaluate, such as agent=q_learning")
    parser.add_argument("--agents", type=int, default=100)
    parser.add_argument("--quick", action="store_true", help="two agents; writes nothing")
    parser.add_argument("--json", type=Path, metavar="PATH", help="write the result there as well")
    args = parser.parse_args()
    num_agents = 2 if args.quick else args.agents
    with tempfile.TemporaryDirectory() as folder:
        proxy = io.load_proxy(one_of_set(args.run, Path(folder)))
        command = [sys.executable, "-m", "sejax.evaluate", f"proxy={proxy.path}",
                   f"num_agents={num_agents}", f"out_dir={folder}",
                   *args.overrides]  # fmt: skip
        subprocess.run(command, check=True)
        evaluation = json.loads((Path(folder) / "evaluation.json").read_text())
    metadata = {k: v for k, v in proxy.metadata.items() if k != "format_version"}
    if not args.quick:
        target = io.PRETRAINED_DIR / f"{args.name}.safetensors"
        weights = proxy.params.weights
        io.save(target, proxy.config, weights, **(metadata | {"evaluation": evaluation}))
    common.finish("ship_proxy", args, {"name": args.name, "evaluation": evaluation})


def one_of_set(run: str, folder: Path) -> str | Path:
    """What to load: a run or a file as it is; one of a set as a file of its own."""
    path, _, place = run.partition("#")
    if not place:
        return run
    index = int(place)
    proxies = load_set(path, "run")
    seed = int(proxies.seeds[index])
    target = folder / "proxy.safetensors"
    io.save(target, dataclasses.replace(proxies.config, seed=seed, num_seeds=1),
            proxies.one(index).weights, score=float(proxies.scores[index]),
            generation=int(proxies.generations[index]), seed=seed)  # fmt: skip
    return target


if __name__ == "__main__":
    main()
