"""Puts a tuner that `experiments.se_tuners` learned into the package, with how it ranks.

    python -m tools.ship_tuner results/se_tuners/cartpole cartpole-tuner

Of the study's tuners it takes the one whose SEs agree best with the configurations that judge, of
which none is learned from and none is held out. Writes `sejax/pretrained/tuners/NAME.safetensors`;
then `python tools/make_zoo.py` makes docs/zoo.md.
"""

import argparse
import dataclasses
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import sejax
from experiments import se_tuners
from experiments.common.shards import read_rows, unstack
from experiments.se_tuners import LEARN, REGRESSED_FROM, SeTuners
from sejax.proxies import header, tuners


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("study", type=Path, help="folder of experiments.se_tuners")
    parser.add_argument("name", help="what sejax.load_set will call it")
    parser.add_argument("--out", type=Path, default=header.TUNERS_DIR, help="folder; sejax's")
    args = parser.parse_args()
    ses = sejax.load_set(args.study / "tuners.safetensors")
    settings = settings_of(args.study)
    places = best(ses.scores, settings.members)
    told = [dict(record) for record in ses[places].records]
    told[0]["tuner"] = dataclasses.asdict(tuner_of(args.study, settings, ses, places))
    weights = [ses[i].params.weights for i in places]
    config = {**ses.config, "seed": int(ses.seeds[places[0]])}
    target = args.out / f"{args.name}.safetensors"
    sejax.save_set(target, ses.env, weights, told, config, ses.discount)
    print(f"{tuners.describe(header.read(target)).card}\n{target}")


def settings_of(study: Path) -> SeTuners:
    """The settings of a study, from the command that its table begins with."""
    from experiments.common import experiment

    command = (study / "table.md").read_text(encoding="utf-8").splitlines()[2].strip("`")
    settings: SeTuners = SeTuners.of(**experiment.parse(shlex.split(command)[3:]))
    return settings


def best(scores: np.ndarray, members: int) -> list[int]:
    """Places of the SEs of the tuner with the highest mean score."""
    first = int(scores.reshape(-1, members).mean(axis=1).argmax()) * members
    return list(range(first, first + members))


def tuner_of(
    study: Path, settings: SeTuners, ses: sejax.ProxySet, places: list[int]
) -> tuners.Tuner:
    """How these SEs were learned, and how they rank held-out configurations."""
    rows = read_rows(study / "rows.csv.xz")
    real, reached = unstack(rows, "real"), unstack(rows, "reached")
    summary = pd.read_csv(study / "summary.csv").set_index(["kind", "ranked_by"])
    learned = real[real["use"] == "learn"]
    curves = unstack(rows, "curves")
    mine = curves[curves["seed"].isin(ses.seeds[places])]
    ranked = []
    for kind in settings.kinds:
        target = se_tuners.returns_of(real, "held", kind, settings.steps).mean(axis=1).to_numpy()
        order = se_tuners.mean_ranks(reached[reached["kind"] == kind], places)
        own = se_tuners.with_interval([order], target)
        landscape = REGRESSED_FROM["regressed" if settings.learn_ranges else "learn"]
        process = summary.loc[kind, f"gaussian process{landscape}"]
        ranked.append(
            {
                "agent": kind,
                "configs": settings.num_configs,
                **{name: own[name] for name in ("rho", "rho_low", "rho_high", "regret")},
                "rho_process": process["rho"],
                "regret_process": process["regret"],
                "regret_chance": summary.loc[(kind, "chance"), "regret"],
            }
        )
    words = [
        *(f"env={settings.env}", "preset=ranking", f"agent={settings.learner}"),
        *("objective.landscape=landscape.csv", *settings.run),
        *(f"seed={ses.seeds[places[0]]}", f"num_seeds={len(places)}"),
    ]
    measured = [
        *(f"env={settings.env}", f"agent={settings.learner}", f"configs={settings.learn_configs}"),
        *(f"seeds={settings.num_seeds}", f"steps={settings.steps}"),
        *(f"seed={settings.seed + LEARN}", "file=landscape.csv", *settings.learn_ranges),
    ]
    values: dict[str, Any] = {
        "name": "",
        "task": ses.task.name,
        "ses": len(places),
        "train_steps": sejax.training_of(ses).max_steps,
        "agent": settings.learner,
        "configs": settings.learn_configs,
        "seeds": settings.num_seeds,
        "steps": settings.steps,
        "real_steps": int(learned["real_steps"].sum()),
        "landscape": f"python -m sejax.landscape {shlex.join(measured)}",
        "command": f"python -m sejax.run {shlex.join(words)}",
        "cpu_s": float(learned["cpu_s"].sum() + mine["cpu_s"].sum()),
        "chosen": f"of {settings.num_tuners} tuners, by the agreement with what judges",
        "ranked": tuple(tuners.Ranked(**each) for each in ranked),
    }
    return tuners.Tuner(**values)


if __name__ == "__main__":
    main()
