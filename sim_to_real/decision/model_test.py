"""The global test of the model: one p-value of all tests, calibrated on quiet recordings.

Three statistics hardly depend on each other in recordings without a gap (|r| < 0.1): the gap of held-out
frames over the floor; the evidence over no gap of the likeliest other hypothesis; and that of the likeliest
random effect. The p-value of each is from its distribution in quiet recordings of the blind check. With the
smallest of three, p, the global p-value is 1 - (1 - p)^3 (Sidak 1967, J. Am. Stat. Assoc. 62, 626).
"""

import math
from dataclasses import dataclass

import numpy as np

from sim_to_real.diagnosis import Gap, ModelTest
from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.variance.random_effects import RandomEffects

PROBABILITIES = (0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98)
"""The probabilities whose quantiles of a quiet distribution are kept."""


@dataclass(frozen=True)
class QuietDistribution:
    """The distribution of a statistic in quiet recordings: its quantiles, and the scale of its upper tail.

    Beyond the last quantile the tail is exponential.
    """

    quantiles: tuple[float, ...]
    tail: float

    def p_value(self, value: float) -> float:
        """Return the probability that a quiet recording has this value or more."""
        first, last = self.quantiles[0], self.quantiles[-1]
        if value > last:
            return (1.0 - PROBABILITIES[-1]) * math.exp((last - value) / self.tail)
        if value < first:
            # The smallest ones tell nothing of a gap: they are spread as far as the next quantiles are.
            reach = max(self.quantiles[2] - first, 1e-9) / math.log(PROBABILITIES[2] / PROBABILITIES[0])
            return 1.0 - PROBABILITIES[0] * math.exp((value - first) / reach)
        return 1.0 - float(np.interp(value, self.quantiles, PROBABILITIES))


QUIET = {
    "held_out_gap": QuietDistribution((0.0, 0.154, 0.298, 0.543, 0.665, 0.759, 0.873, 0.966, 1.024), 0.129),
    "bins": QuietDistribution((-5.402, -5.276, -5.211, -5.036, -4.851, -4.595, -3.970, -2.909, -2.730), 1.0),
    "scatter": QuietDistribution(
        (-2.289, -2.288, -2.288, -2.281, -2.183, -1.940, -1.733, -1.571, -0.831), 1.0
    ),
}
"""Distributions of the statistics: of 91 of 207 quiet recordings, `python benchmarks/model_test.py`.

Evidence has a tail of 1 nat: a true null has x nats against it with a probability of exp(-x) at most.
"""


def model_test(gap: Gap, posterior: Posterior, random: RandomEffects) -> ModelTest:
    """Return the global p-value, and that of each test; a test without a statistic is left out.

    `random` are the random effects of a fit without effects.
    """
    others = [posterior.unknown.evidence, *(h.evidence for h in posterior.hypotheses)]
    others += [h.with_unknown.evidence for h in posterior.hypotheses if h.with_unknown is not None]
    statistics = {
        "held_out_gap": gap.before / gap.floor,
        "bins": max(others) - posterior.none.evidence,
        "scatter": max(random.evidence.values(), default=math.nan),
    }
    p_values = {
        name: QUIET[name].p_value(value) for name, value in statistics.items() if math.isfinite(value)
    }
    return ModelTest(global_p_value(list(p_values.values())), p_values)


def global_p_value(p_values: list[float]) -> float:
    """Return the probability that the smallest of some independent p-values is as small as theirs is."""
    # 1 - (1 - p)^n, also where 1 - p is 1.
    return -math.expm1(len(p_values) * math.log1p(-min(p_values))) if p_values else math.nan
