"""The myopia test: does what is learned teach by its rewards alone, or by its dynamics?

An agent with a discount of 0 sees the reward of its next step alone. What teaches it as much as a
far-sighted agent is a policy in disguise, however long its episodes are.

Scores are test returns, from those of untrained agents (the floor) to the task's solved return. Of
a reward network, on which all agents learn sooner or later, they are training steps with a minus
sign, from those of agents without it to none. A difference below `MARGIN` of the way counts as
none; more and less are those of Student's interval over agents, in pairs of equal seeds.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

MARGIN = 0.1
LEVEL = 0.95
LEAST = 5  # independent values that an interval needs
NONE = (math.nan, math.nan)  # of fewer


def mean_interval(values: ArrayLike, level: float = LEVEL) -> tuple[float, float]:
    """Student's confidence interval of the mean of independent values `[n]`; `NONE` if n < `LEAST`.

    Average what belongs together before, such as the agents that one proxy trained.
    """
    values = np.asarray(values, float)
    if values.size < LEAST:
        return NONE
    half = stdtrit(values.size - 1, (1 + level) / 2) * values.std(ddof=1) / values.size**0.5
    return float(values.mean() - half), float(values.mean() + half)


class Judgement(NamedTuple):
    """What a proxy is to agents of one algorithm.

    Attributes:
      verdict: policy, dynamics, teaches little, or open.
      loss: mean score that a discount of 0 costs, and the ends `low` and `high` of its interval.
      missing: agents that may decide beside these, where it is open.
    """

    verdict: str
    loss: float
    low: float
    high: float
    missing: int


def judge(myopic: ArrayLike, far: ArrayLike, floor: ArrayLike, top: float) -> Judgement:
    """Judges by the scores of agents with a discount of 0 and with their own.

    - dynamics: they differ by more than the margin;
    - policy: by less, and the far-sighted score more than the margin above the floor;
    - teaches little: they do not;
    - open: the intervals hold both.

    Args:
      myopic: scores of agents with a discount of 0, `[n]`.
      far: of agents of the same seeds with their own discount, `[n]`.
      floor: of agents that nothing was taught, `[n]` or a number.
      top: score of agents that were taught all.

    Example:
      >>> judge([98, 99, 97, 99, 98], [99, 98, 99, 99, 99], 20.0, 95.0).verdict
      'policy'
    """
    far, floor = np.asarray(far, float), np.asarray(floor, float)
    margin = MARGIN * (top - floor.mean())
    lost, gained = far - myopic, far - floor
    (low, high), (gain_low, gain_high) = mean_interval(lost), mean_interval(gained)
    if low > margin:
        verdict = "dynamics"
    elif high < margin < gain_low:
        verdict = "policy"
    else:
        verdict = "teaches little" if gain_high < margin else "open"
    halves = np.array([high - low, gain_high - gain_low]) / 2
    distances = np.abs([lost.mean() - margin, gained.mean() - margin])
    # The width of an interval falls with the root of the number of agents.
    needed = len(far) * np.max((halves / np.maximum(distances, 1e-9)) ** 2)
    missing = math.ceil(min(needed, 1e6)) - len(far) if math.isfinite(needed) else LEAST - len(far)
    return Judgement(verdict, float(lost.mean()), low, high, max(1, missing))


def verdict_of(judgements: Collection[Judgement]) -> str:
    """The verdict on a proxy, in words, by those of all algorithms that it was learned with.

    One algorithm that learns as much without looking ahead shows that the rewards hold a policy.
    That the dynamics teach is said if all that learn must look ahead.
    """
    verdicts = {judgement.verdict for judgement in judgements}
    if "policy" in verdicts:
        return "a stored policy"
    if "open" in verdicts:
        missing = max(x.missing for x in judgements if x.verdict == "open")
        return f"undecided: {missing:,} more agents"
    return "its dynamics teach" if "dynamics" in verdicts else "teaches little"
