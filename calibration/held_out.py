"""Choice of a model by cross-validation: how well the other boards predict each.

The best model has the least mean loss of boards that are held out. Taken is the leanest whose mean is within
one standard error of the best's, of the differences from board to board (Breiman et al., Classification and
regression trees, 1984, section 3.4.3), or against which the best has no strong evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from noise_model.compiled.arrays import Float64


@dataclass(frozen=True)
class HeldOutScore:
    """Cross-validation of a model.

    `loss` (V,) is each board's mean square of errors when held out, `log_evidence` the model's marginal
    likelihood up to a constant of all models.
    """

    name: str
    loss: Float64
    log_evidence: float

    @property
    def mean(self) -> float:
        """The mean over boards."""
        return float(self.loss.mean())

    def excess(self, best: HeldOutScore) -> tuple[float, float]:
        """Return the difference of the mean from that of the best, and its standard error."""
        worse = self.loss - best.loss
        return float(worse.mean()), float(worse.std(ddof=1) / np.sqrt(len(worse)))


Score = TypeVar("Score", bound=HeldOutScore)


def choose_leanest(scores: Sequence[Score]) -> Score:
    """Return the first model that predicts as well as the best, or has little less evidence."""
    best = min(scores, key=lambda each: each.mean)
    for each in scores:
        worse, error = each.excess(best)
        # Odds of e^3 are strong evidence (Kass and Raftery, Bayes factors, 1995, section 3.2).
        if worse <= error or best.log_evidence - each.log_evidence <= 3.0:
            return each
    return best
