"""How fast agents learn with learned rewards: test returns against training steps for each RN.

Source: paper, section "Experiments with Reward Networks" (figure with the average cumulative test
rewards, and the rows for default hyperparameters, varied ones and unseen agents), appendix
"HalfCheetah RNs Plots"; `docs/reference.md` 7.3.

The RNs of each variant are learned first (`learned`), and are kept for all experiments. On each of
the best `rns` of them `num_agents` agents are trained in each row, and as many on the real task
alone and with an exploration bonus. Episodes of training and of greedy testing on the real task
alternate, and nothing stops an agent early. The paper shows curves and gives no numbers: on each
task some variant learns faster than all agents without an RN, the additive ones most reliably.

Differs: agents stop after the steps that the paper's figure shows, or its number of episodes.
"""

from dataclasses import dataclass

import pandas as pd

from experiments.common import reward_networks, rn_curves
from experiments.common.experiment import Experiment, setting
from experiments.common.rn_curves import CurveSettings
from experiments.common.tables import publish


@dataclass(frozen=True, kw_only=True)
class RnPerformance(CurveSettings):
    """Settings of this experiment.

    Attributes:
      objective: that RNs are learned by
    """

    name = "rn_performance"

    objective: str = setting("reward_threshold", reward_networks.OBJECTIVES)


def compute(settings: RnPerformance) -> pd.DataFrame:
    """Learns and trains what is missing; each agent's curve, as `curves.thinned` leaves it."""
    reward_networks.check_stored(settings, [settings.objective])
    tables = [*rn_curves.real_curves(settings)]
    for variant in settings.variants:
        rns = reward_networks.learn(settings, variant, settings.objective).ranked(settings.rns)
        tables += rn_curves.rn_curves(settings, variant, rns)
    return rn_curves.by_row(settings, pd.concat(tables))


def report(settings: RnPerformance, curves: pd.DataFrame) -> pd.DataFrame:
    solved_reward = settings.task.solved_reward
    rn_curves.draw(settings, {f"test return on {settings.env}": curves}, 3.1, "performance.png")
    summary = rn_curves.summarise(curves, settings.max_steps)
    bonuses = set(settings.bonuses) - {"none"}
    with_bonus = f" (with a bonus: {settings.bonus_groups})" if bonuses else ""
    note = (
        f"The best {settings.rns} of {settings.learned} RNs of each variant, learned by "
        f"{settings.objective}, with {settings.num_agents} agents each, and as many groups on the "
        f"real task{with_bonus}; {rn_curves.common_note(settings, solved_reward)}"
    )
    title = f"Agents trained with reward networks and tested on {settings.env}"
    return publish(settings, title, rn_curves.make_table(summary), summary, note)


EXPERIMENT = Experiment(settings=RnPerformance, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
