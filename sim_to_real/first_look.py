"""A first look at a gap: how large it is, and which single effects would close most of it, in some seconds.

It is the diagnosis' own baseline and score test on a dozen frames. No effect is fitted, nothing is held out:
what it names is what to look at first. `diagnose` judges.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from noise_model.setup import Setup
from sim_to_real.baseline import baseline_of
from sim_to_real.data.binned import PoseAt, observe
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.search.score_test import FAMILIES, score_effects
from tracker.state import Frame

MIN_CLOSED, MAX_RIVAL_SHARE = 0.5, 0.5
"""An effect is named where it closes half of the gap and leaves half at most of what the next one leaves."""


@dataclass(frozen=True)
class FirstLook:
    """Quick comparison of frames with the model.

    `mean_square` is of the residuals over their stated sigmas, with the nuisances fitted; about 1 without a
    gap. `closed` are the effects that would close most of the gap, with the share that each closes, the best
    first.
    """

    mean_square: float
    closed: tuple[tuple[str, float], ...]

    @property
    def is_gap(self) -> bool:
        """True if the nominal model leaves something to explain."""
        # The model's floor is in it, so it is above 1.
        return self.mean_square > 1.5

    @property
    def likely(self) -> tuple[str, ...]:
        """Likely effects: one, or all that cannot be separated; none where none closes half."""
        if not self.is_gap or not self.closed or self.closed[0][1] < MIN_CLOSED:
            return ()
        remaining = 1.0 - self.closed[0][1]
        return tuple(
            name
            for name, closed in self.closed
            if closed >= MIN_CLOSED and remaining > MAX_RIVAL_SHARE * (1.0 - closed)
        )


def first_look(setup: Setup, frames: Sequence[Frame], pose_at: PoseAt) -> FirstLook:
    """Compare a dozen frames from different places with the model.

    `pose_at` gives the tool's pose at a time, or None. Raises ValueError for a setup without arc, filter or
    metal, or if nothing in the frames can be compared.
    """
    setup.require("a first look", "arc", "filter", "material")
    with threadpool_limits(1, user_api="blas"):
        observed = observe(setup, frames, pose_at)
        model, baseline, _ = baseline_of(LinearizedModel(observed, 1), ())
        scores = score_effects(model, baseline, list(FAMILIES))
    # A model without a gap leaves a mean square of 0.6 or more.
    gap = max(baseline.mean_square - 0.6, 1e-9)
    closed = [(score.id, (baseline.mean_square * (1.0 - score.residual_fraction)) / gap) for score in scores]
    return FirstLook(baseline.mean_square, tuple((name, min(share, 1.0)) for name, share in closed))
