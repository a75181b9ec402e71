"""The myopia test: does a learned proxy teach by its rewards alone, or by its dynamics?

An agent with a discount of 0 sees only the reward of its next step. A proxy that teaches it as much
as a far-sighted agent is a policy in disguise, however long its episodes are.

Scores are test returns, from the return of untrained agents (the floor) to the task's solved
return. With a reward network all agents learn sooner or later. There scores are minus the training
steps, from the score of agents without the network to 0. A difference below `MARGIN` of this range
counts as none. Student's interval over agents, paired by seed, decides what is above and below.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

MARGIN = 0.1
LEVEL = 0.95
ENOUGH = 5  # independent values that an interval needs
UNKNOWN = (math.nan, math.nan)  # the interval of fewer values


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """Student's 95% interval of the mean of independent values `[n]`; (nan, nan) if n < 5.

    First average values that depend on each other, such as the agents that one proxy trained.
    """
    values = np.asarray(values, float)
    if values.size < ENOUGH:
        return UNKNOWN
    half = stdtrit(values.size - 1, (1 + LEVEL) / 2) * values.std(ddof=1) / values.size**0.5
    return float(values.mean() - half), float(values.mean() + half)


class Judgement(NamedTuple):
    """What a proxy is to agents of one algorithm.

    Attributes:
      verdict: policy, dynamics, teaches little, or open.
      loss: mean score that a discount of 0 costs, and the ends `low` and `high` of its interval.
      missing: number of further agents that may decide an open verdict.
    """

    verdict: str
    loss: float
    low: float
    high: float
    missing: int


def judge(myopic: ArrayLike, far: ArrayLike, floor: ArrayLike, top: float) -> Judgement:
    """Compares agents with a discount of 0 to far-sighted ones, with their own discount.

    - teaches little: far-sighted agents score above the floor by less than the margin, or the
      floor is the top;
    - dynamics: they score above it by more, and above the others by more than the margin;
    - policy: they score above it by more, and above the others by less than the margin;
    - open: an interval contains the margin.

    The margin is a tenth of what there is to learn, 0.1 (top - mean of floor). Intervals are at
    95%.

    Args:
      myopic: scores of agents with a discount of 0, `[n]`.
      far: scores of agents with the same seeds and their own discount, `[n]`.
      floor: scores of agents that learned nothing, `[n]` or a number.
      top: score of agents that learned all.

    Raises:
      ValueError: if not as many agents are myopic as far-sighted.

    Example:
      >>> judge([98, 99, 97, 99, 98], [99, 98, 99, 99, 99], 20.0, 95.0).verdict
      'policy'
    """
    myopic, far, floor = (np.asarray(scores, float) for scores in (myopic, far, floor))
    if myopic.shape != far.shape:
        raise ValueError(f"myopic has the shape {myopic.shape}, far {far.shape}; seeds are paired")
    margin = MARGIN * (top - floor.mean())
    lost, gained = far - myopic, far - floor
    (low, high), (gain_low, gain_high) = mean_interval(lost), mean_interval(gained)
    if gain_high < margin or margin <= 0:
        verdict = "teaches little"
    elif gain_low > margin and not low <= margin <= high:
        verdict = "dynamics" if low > margin else "policy"
    else:
        verdict = "open"
    halves = np.array([high - low, gain_high - gain_low]) / 2
    distances = np.abs([lost.mean() - margin, gained.mean() - margin])
    # The width of an interval falls with the square root of the number of agents.
    needed = len(far) * np.max((halves / np.maximum(distances, 1e-9)) ** 2)
    num_agents = math.ceil(min(needed, 1e6)) if math.isfinite(needed) else ENOUGH
    return Judgement(verdict, float(lost.mean()), low, high, max(1, num_agents - len(far)))


def verdict_of(judgements: Collection[Judgement], teaches: str = "its dynamics teach") -> str:
    """The verdict on a proxy, in words, from a judgement for each algorithm it was learned with.

    If one algorithm learns as much without looking ahead, the rewards hold a policy. The dynamics
    teach if every algorithm that learns must look ahead; `teaches` says so, and of an RN that its
    reward does.
    """
    verdicts = {judgement.verdict for judgement in judgements}
    if "policy" in verdicts:
        return "a stored policy"
    if "open" in verdicts:
        missing = max(x.missing for x in judgements if x.verdict == "open")
        return f"undecided: {missing:,} more agents"
    return teaches if "dynamics" in verdicts else "teaches little"
