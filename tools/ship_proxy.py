"""Puts a learned proxy into the package, with the numbers of its evaluation in its record.

    python tools/ship_proxy.py runs/cartpole-se-ddqn-s1 cartpole
    python tools/ship_proxy.py runs/cliff_walking-rn-q_learning-s0 cliff_walking-rn agent=q_learning
    python tools/ship_proxy.py rns/additive_potential.safetensors#3 cartpole-rn

Runs `python -m sejax.evaluate` on it (fresh agents with the paper's default hyperparameters, and as
many on the real task) and writes `sejax/pretrained/NAME.safetensors`.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import jax

from sejax.proxies import files


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", help="run directory or file of the proxy, or SET#PLACE")
    parser.add_argument("name", help="what sejax.load will call it")
    parser.add_argument("overrides", nargs="*", help="of sejax.evaluate, such as agent=q_learning")
    parser.add_argument("--agents", type=int, default=100)
    parser.add_argument("--out", type=Path, default=files.PRETRAINED_DIR, help="folder; sejax's")
    args = parser.parse_args()
    path, _, place = args.run.partition("#")
    proxy = files.load_set(path, option="run").select([int(place or 0)])
    with tempfile.TemporaryDirectory() as folder:
        alone = Path(folder) / "proxy.safetensors"
        save(alone, proxy)
        evaluation = evaluate(alone, args.agents, args.overrides)
    target = args.out / f"{args.name}.safetensors"
    save(target, proxy, evaluation=evaluation)
    print(f"{target}: {json.dumps(evaluation)}")


def save(path: Path, proxy: files.ProxySet, **more: object) -> None:
    """Writes a set of one as a single proxy, with more in its record."""
    record = {**proxy.records[0], **more}
    config = {**proxy.config, "seed": record.get("seed"), "num_seeds": 1}
    weights = jax.tree.map(lambda x: x[0], proxy.weights)
    files.save(path, proxy.env, weights, config, proxy.discount, **record)


def evaluate(path: Path, num_agents: int, overrides: list[str]) -> dict[str, object]:
    """What `python -m sejax.evaluate` says of a proxy."""
    command = [sys.executable, "-m", "sejax.evaluate", f"proxy={path}", f"num_agents={num_agents}",
               f"out_dir={path.parent}", *overrides]  # fmt: skip
    subprocess.run(command, check=True)
    return json.loads((path.parent / "evaluation.json").read_text())


if __name__ == "__main__":
    main()
