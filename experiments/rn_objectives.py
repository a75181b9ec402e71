"""What RNs are learned for: the reward threshold, the area under the curve, or the final return.

Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
Objectives"; `docs/reference.md` 7.3 and 7.4.

As `rn_performance`, once for each objective. The authors' scripts picked the ten RNs with the
*lowest* scores for two of the three objectives; both choices are shown here, `best` and `worst`, of
half of the RNs at most each. The paper shows curves and gives no numbers. It concludes that the
area does about as well as the threshold, and that the final return makes learning faster on
CartPole but not on Cliff Walking.

Differs: the area under the curve is divided by the training steps; the authors' is `auc_sum`, for
which falling off the cliff at once is best.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.common import reward_networks, rn_curves, tables
from experiments.common.experiment import Experiment, setting
from experiments.common.rn_curves import CurveSettings
from sejax.options import require

PICKS = ("best", "worst")  # by their scores
OBJECTIVE_NAMES = {
    "reward_threshold": "reward threshold",
    "auc": "area under the curve",
    "max_reward": "final return",
    "auc_sum": "area, not by steps",
}
DEFAULT_OBJECTIVES = ("reward_threshold", "auc", "max_reward")


@dataclass(frozen=True, kw_only=True)
class RnObjectives(CurveSettings):
    """Settings of this experiment.

    Attributes:
      objectives: Of reward_threshold, auc, max_reward, auc_sum.
      picks: RNs that train agents: best, worst (as the authors' scripts for two objectives).
    """

    name = "rn_objectives"

    objectives: tuple[str, ...] = setting(DEFAULT_OBJECTIVES, OBJECTIVE_NAMES)
    picks: tuple[str, ...] = setting(PICKS, PICKS)

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        default = super().defaults(given)
        if len(given.get("picks", PICKS)) > 1:  # as few as leave picks apart
            half = given.get("learned", default["learned"]) // 2
            default["rns"] = max(1, min(default["rns"], half))
        return default | {"bonus_groups": given.get("rns", default["rns"])}

    def __post_init__(self) -> None:
        super().__post_init__()
        least = len(self.picks) * self.rns
        must = f"must be at least {least}, of which the best and the worst are picked"
        use = f"{least} or picks=best"
        require(self.learned >= least, "learned", must, got=self.learned, use=use)


def compute(settings: RnObjectives) -> pd.DataFrame:
    """As of rn_performance; agents without an RN are there once for all objectives."""
    reward_networks.check_stored(settings, settings.objectives)
    parts = [table.assign(objective="", pick="") for table in rn_curves.real_curves(settings)]
    for objective in settings.objectives:
        learned = {
            name: reward_networks.learn(settings, name, objective) for name in settings.variants
        }
        for pick, (variant, rns) in itertools.product(settings.picks, learned.items()):
            picked = rns.ranked(settings.rns, worst=pick == "worst")
            made = rn_curves.rn_curves(settings, variant, picked, f"{objective}-{pick}-")
            parts += [table.assign(objective=objective, pick=pick) for table in made]
    return pd.concat(parts, ignore_index=True)


def report(settings: RnObjectives, rows: pd.DataFrame) -> pd.DataFrame:
    solved_reward = settings.task.solved_reward
    summary = pd.concat(
        rn_curves.summarise(beside(settings, rows, objective, pick), settings.max_steps).assign(
            objective=objective, pick=pick
        )
        for objective, pick in itertools.product(settings.objectives, settings.picks)
    )
    has_rn = ~summary["world"].isin(rn_curves.WITHOUT_RN)
    table = rn_curves.make_table(summary)
    table.insert(0, "RNs", [*summary["pick"].where(has_rn, "")])
    table.insert(0, "objective", [*summary["objective"].map(OBJECTIVE_NAMES).where(has_rn, "")])
    table = table.iloc[np.argsort(has_rn, kind="stable")].drop_duplicates(ignore_index=True)
    for pick in settings.picks:
        curves = {
            f"{OBJECTIVE_NAMES[name]}\ntest return": beside(settings, rows, name, pick)
            for name in settings.objectives
        }
        rn_curves.draw(settings, curves, 2.7, f"{pick}.png")
    note = (
        f"{settings.learned} RNs of each variant were learned by each objective. Of these the "
        f"{settings.rns} with the highest (best) or lowest (worst) scores train "
        f"{settings.num_agents} agents each, for {rn_curves.common_note(settings, solved_reward)} "
        "The area is by training steps, where the authors' code has the sum."
    )
    title = f"Objectives of reward networks on {settings.env}"
    return tables.publish(settings, title, table, summary, note)


def beside(settings: RnObjectives, rows: pd.DataFrame, objective: str, pick: str) -> pd.DataFrame:
    """Curves of the agents without an RN, which come first, and of the RNs picked."""
    mine = (rows["objective"] == objective) & (rows["pick"] == pick)
    return rn_curves.by_row(settings, rows[mine | rows["world"].isin(rn_curves.WITHOUT_RN)])


EXPERIMENT = Experiment(settings=RnObjectives, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
