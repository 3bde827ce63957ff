"""Effects that were fitted together, and how much speaks for them: frames that were held out, and the price.

A candidate's score is the mean square R of the residuals in frames that its fit did not see. As if
N_EFFECTIVE residuals were independent and of unknown scale, their likelihood is R^(-N_EFFECTIVE / 2), and
a parameter costs what it costs in Schwarz's criterion (1978, Ann. Statist. 6, 461): neighbouring bins share
the model's error, so the number of bins says nothing about how sure one may be.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noise_model.arrays import Float64
from sim_to_real.data.cross_validation import folds, sees_as_much
from sim_to_real.fit.gauss_newton import FLICKER, NAMED_FROM, Refit, huber_weights
from sim_to_real.fit.linearized_model import Expected
from sim_to_real.fit.nuisances import SEAM_FROM
from sim_to_real.fit.quadratic import N_EFFECTIVE, Quadratic

JUDGED_WITHIN = 10.0
"""Residuals beyond so many sigmas count as if they were that large: a streak is no more than a streak."""

HELD_DAMPING = 0.03
"""Fits to some of the frames are damped: where hardly anything is seen they would leave what is linear."""

FORM_REL = 0.1
"""An effect's form is known to this share of what it changes: catalogues simplify."""

FOLDS = 5
"""So many times some of the frames are held out."""

LEAST_LEFT = 0.6
"""What leaves less leaves nothing. A model without a gap leaves 0.6 to 0.9: its floor is a generous one."""

ON_BOUND = 1e-3
"""So near a bound, as a share of how far the bounds are apart, a parameter lies on it."""

ONE_EXPLAINS = 0.08
"""A gap of which more is left beyond what its form may be off is not explained by one effect."""

PIXELS_EXPLAINED = 0.05
"""Of a gap that pixels show one effect may leave so much: bins are predicted by a coarse camera."""

AT_FLOOR = 1.5
"""What leaves less in pixels shows no gap there: the model's floor is 1."""

SHOWN_FROM = 0.7
"""What leaves less in pixels, and in bins no more than the model's floor, is no gap."""

CLEARLY_LEFT = 1.3
"""A mean square from which there is more to be explained even where one effect explains most of a gap."""

HALVES = 0.5
"""What explains bins must leave no more of what pixels show; nor must others beside it of what it leaves."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Effects fitted together: `costs` (n_frames,) are the sums of squares of frames held out of the fit.

    `left_in_pixels` is the mean square that they leave there if it was asked for, NaN if not, and `against`
    what it says against them, nats: it sets apart those whose bins are alike.
    """

    refit: Refit
    costs: Float64
    left_in_pixels: float = math.nan
    against: float = 0.0

    @property
    def ids(self) -> tuple[str, ...]:
        """The effects."""
        return self.refit.ids

    @property
    def left(self) -> float:
        """The mean square of the residuals in frames held out."""
        return float(self.costs.sum() / self.refit.quadratic.counts.sum())

    @property
    def of_bins(self) -> float:
        """The logarithm of the candidate's likelihood in bins, less what its parameters cost.

        It compares what pixels were asked of with what they were not.
        """
        return likelihood_nats(self.left) - cost_nats(self.refit.n_parameters)

    @property
    def evidence(self) -> float:
        """The same less what pixels say against the candidate."""
        return self.of_bins - self.against

    @property
    def held_back(self) -> float:
        """What the fit would gain beyond the bounds that its effects' parameters lie on, nats.

        An effect that would go on is another one's mimic. Where the bound is neutral it is just not there.
        """
        quadratic, x = self.refit.quadratic, self.refit.x
        start, lower, upper = np.array([(p.start, p.lower, p.upper) for p in quadratic.parameters]).T
        reach = upper - lower
        near = np.where(np.isfinite(reach), ON_BOUND * reach, 0.0)
        on_bound = np.zeros(len(x), dtype=np.bool_)
        for bound in (lower, upper):
            on_bound |= (np.abs(x - bound) <= near) & (np.abs(start - bound) > near)
        on_bound[: self.refit.n_nuisances] = False
        if not on_bound.any():
            return 0.0
        freed = quadratic.without_bounds(on_bound)
        return likelihood_nats(freed.mean_square(freed.solve())) - likelihood_nats(self.refit.mean_square)

    @cached_property
    def is_held_back(self) -> bool:
        """Whether its bounds hold it back from what would be preferred."""
        return self.held_back >= NAMED_FROM


def beyond_form(expected: Expected, candidate: Candidate) -> float:
    """Return what a candidate leaves if what its effects change may be off by `FORM_REL` of it."""
    fitted = candidate.refit
    without = expected.residuals(expected.passed(fitted.nuisance, {}))
    r = np.clip(fitted.residuals, -JUDGED_WITHIN, JUDGED_WITHIN)
    off = FORM_REL * (without - fitted.residuals)
    return candidate.left * float(np.sum(r**2 / (1.0 + off**2)) / np.sum(r**2))


def likelihood_nats(left: float) -> float:
    """Return the logarithm of the likelihood of residuals' mean square: `LEAST_LEFT` is as good as can be."""
    return -0.5 * N_EFFECTIVE * math.log(max(left, LEAST_LEFT))


def cost_nats(n_parameters: int) -> float:
    """Return what parameters cost of the evidence."""
    return 0.5 * n_parameters * math.log(N_EFFECTIVE)


def judged(expected: Expected, fitted: Refit) -> Candidate:
    """Return a fit with the costs of its frames, each as the other folds' fit predicts it.

    But for the seam, which stays where all frames have it: others do not foresee where a frame's own runs.
    """
    # All candidates are judged by one loss: each was fitted with a bound of its own.
    plain = Quadratic.of(
        fitted.quadratic.parameters,
        fitted.x,
        fitted.residuals,
        fitted.jacobian,
        huber_weights(fitted.residuals, JUDGED_WITHIN) ** 2,
        fitted.quadratic.counts,
    )
    if FLICKER in fitted.ids:
        # A level of its own needs the frame itself; thousands of bins share that one number.
        return Candidate(fitted, plain.chi2)
    fold, of_seam = folds(expected.observed, FOLDS), slice(SEAM_FROM, fitted.n_nuisances)
    costs = np.zeros(len(fold))
    for k in range(FOLDS):
        held = fold == k
        if held.any():
            # Without a source's light its level is known by its tolerance alone: the fit that saw it judges.
            is_fair = sees_as_much(expected.observed, ~held)
            x = fitted.quadratic.solve(~held, HELD_DAMPING, of_seam) if is_fair else fitted.x
            costs[held] = plain.costs(x)[held]
    return Candidate(fitted, costs)


def best_first(found: Iterable[Candidate]) -> list[Candidate]:
    """Return candidates, likeliest first."""
    return sorted(found, key=lambda candidate: -candidate.evidence)


def confidences(of: Sequence[Candidate], baseline: Candidate) -> Float64:
    """Return how probable each candidate (n,) is, if one of them is right or the baseline.

    What its bounds hold back is another one's mimic: it takes nothing from a first one that is free.
    """
    evidence = np.array([*(candidate.evidence for candidate in of), baseline.evidence])
    mimics = [one.is_held_back and not of[0].is_held_back for one in of]
    evidence[:-1][mimics] = -math.inf
    weight = np.exp(evidence - evidence.max())
    return np.asarray(weight / weight.sum())[:-1]


def left_over(candidate: Candidate, baseline: Candidate) -> float:
    """Return the share of the baseline's gap that a candidate leaves above the model's floor, 0 to 1."""
    gap = max(baseline.left - 1.0, 0.0)
    return min(max(candidate.left - 1.0, 0.0) / gap, 1.0) if gap > 0.0 else 0.0


def is_explained(expected: Expected, candidate: Candidate, baseline: Candidate) -> bool:
    """Say whether one effect explains a gap: it leaves little beyond what its form may be off.

    Or it leaves hardly anything in pixels, and they showed the gap. If they were asked it must halve that.
    What would explain it better beyond its bounds does not.
    """
    if candidate.is_held_back:
        return False
    shown = baseline.left_in_pixels
    if shown > AT_FLOOR and math.isfinite(candidate.left_in_pixels):
        share = (candidate.left_in_pixels - 1.0) / (shown - 1.0)
        if share <= PIXELS_EXPLAINED:
            return True
        if share > HALVES:
            return False
    return beyond_form(expected, candidate) - 1.0 <= ONE_EXPLAINS * max(baseline.left - 1.0, 0.0)
