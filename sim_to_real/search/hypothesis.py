"""A hypothesis: effects that were fitted together, with the evidence for them.

The score of a hypothesis is the mean square R of the residuals in frames that its fit did not see. The
likelihood is R^(-N_EFFECTIVE / 2), that of N_EFFECTIVE independent residuals of unknown scale. Each parameter
costs what it does in Schwarz's criterion (BIC; 1978, Ann. Statist. 6, 461). The number of bins does not
enter: neighbouring bins share the model's error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noise_model.arrays import Float64
from sim_to_real.data.cross_validation import folds, shows_same_sources
from sim_to_real.fit.gauss_newton import FLICKER, MIN_EVIDENCE_NATS, Refit, huber_weights
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import SEAM_FROM
from sim_to_real.fit.quadratic import N_EFFECTIVE, Quadratic

CLIP_SIGMAS = 10.0
"""Residuals are clipped at so many sigmas when hypotheses are compared: a streak must not decide."""

FOLD_DAMPING = 0.03
"""Damping of fits to some of the frames: without it a poorly seen parameter leaves the linear range."""

FORM_REL = 0.1
"""An effect's form is known to within this share of what it changes: the catalogue simplifies."""

N_FOLDS = 5
"""Folds of the cross-validation."""

MIN_MEAN_SQUARE = 0.6
"""A smaller mean square counts as this one: a model without a gap leaves 0.6 to 0.9."""

BOUND_TOLERANCE = 1e-3
"""A parameter is on a bound if it is nearer than this share of the distance between its bounds."""

MAX_RESIDUAL_FRACTION = 0.08
"""One effect explains a gap if it leaves no more than this, beyond the error of the effect's own form."""

MAX_PIXEL_FRACTION = 0.05
"""One effect explains a gap that pixels show if it leaves no more than this of it in pixels.

Bins alone do not decide there: they are predicted by a coarse camera.
"""

MAX_MISFIT_AT_FLOOR = 1.5
"""A smaller misfit in pixels shows no gap: the model's floor is 1."""

MIN_VISIBLE_MISFIT = 0.7
"""A smaller misfit in pixels is no gap, if bins show no more than the model's floor either."""

UNRESOLVED_MEAN_SQUARE = 1.3
"""From this mean square on there is more to explain, even if one effect explains most of the gap."""

MAX_PIXEL_FRACTION_KEPT = 0.5
"""An explanation of the bins must leave no more than this share of what pixels show.

Further effects beside it must leave no more than this share of what it leaves.
"""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects fitted together; `costs` (n_frames,) are sums of squares of frames held out of the fit.

    `pixel_misfit` is what the fit leaves in pixels, over the model's floor; NaN if it was not computed.
    `pixel_penalty_nats` is how much less likely that makes this hypothesis than others whose bins fit as
    well.
    """

    refit: Refit
    costs: Float64
    pixel_misfit: float = math.nan
    pixel_penalty_nats: float = 0.0

    @property
    def ids(self) -> tuple[str, ...]:
        """The effects."""
        return self.refit.ids

    @property
    def cv_mean_square(self) -> float:
        """The cross-validated mean square R: that of the residuals in frames held out of the fit."""
        return float(self.costs.sum() / self.refit.quadratic.counts.sum())

    @property
    def bin_evidence(self) -> float:
        """The logarithm of the likelihood in bins less the parameters' penalty, nats.

        Hypotheses with and without a pixel misfit are compared by it.
        """
        return likelihood_nats(self.cv_mean_square) - bic_penalty_nats(self.refit.n_parameters)

    @property
    def evidence(self) -> float:
        """The evidence of bins less the penalty of pixels, nats."""
        return self.bin_evidence - self.pixel_penalty_nats

    @property
    def gain_beyond_bounds_nats(self) -> float:
        """The log-likelihood that the fit would gain if parameters on a bound could pass it, nats.

        An effect that wants to pass its bounds mimics another one. A bound at which the effect vanishes does
        not count: there the effect is merely absent.
        """
        quadratic, x = self.refit.quadratic, self.refit.x
        start, lower, upper = np.array([(p.start, p.lower, p.upper) for p in quadratic.parameters]).T
        reach = upper - lower
        near = np.where(np.isfinite(reach), BOUND_TOLERANCE * reach, 0.0)
        on_bound = np.zeros(len(x), dtype=np.bool_)
        for bound in (lower, upper):
            on_bound |= (np.abs(x - bound) <= near) & (np.abs(start - bound) > near)
        on_bound[: self.refit.n_nuisances] = False
        if not on_bound.any():
            return 0.0
        freed = quadratic.without_bounds(on_bound)
        return likelihood_nats(freed.mean_square(freed.solve())) - likelihood_nats(self.refit.mean_square)

    @cached_property
    def is_bound_limited(self) -> bool:
        """Whether it would be clearly likelier with parameters beyond their bounds."""
        return self.gain_beyond_bounds_nats >= MIN_EVIDENCE_NATS


def mean_square_beyond_form(model: LinearizedModel, hypothesis: Hypothesis) -> float:
    """Return the mean square R if the effects' form may be wrong by `FORM_REL` of what they change."""
    fitted = hypothesis.refit
    without = model.residuals(model.lights(fitted.nuisance, {}))
    r = np.clip(fitted.residuals, -CLIP_SIGMAS, CLIP_SIGMAS)
    off = FORM_REL * (without - fitted.residuals)
    return hypothesis.cv_mean_square * float(np.sum(r**2 / (1.0 + off**2)) / np.sum(r**2))


def likelihood_nats(mean_square: float) -> float:
    """Return the log-likelihood of a mean square of residuals; below `MIN_MEAN_SQUARE` it is constant."""
    return -0.5 * N_EFFECTIVE * math.log(max(mean_square, MIN_MEAN_SQUARE))


def bic_penalty_nats(n_parameters: int) -> float:
    """Return the penalty of so many parameters by Schwarz's criterion, nats."""
    return 0.5 * n_parameters * math.log(N_EFFECTIVE)


def cross_validated(model: LinearizedModel, fitted: Refit) -> Hypothesis:
    """Return a fit with the costs of its frames, each as a fit to the other folds predicts it.

    The seam's parameters stay as all frames have them: other frames do not show a frame's own piece of seam.
    """
    # One loss for all hypotheses: each was fitted with a Huber bound of its own.
    plain = Quadratic.of(
        fitted.quadratic.parameters,
        fitted.x,
        fitted.residuals,
        fitted.jacobian,
        huber_weights(fitted.residuals, CLIP_SIGMAS) ** 2,
        fitted.quadratic.counts,
    )
    if FLICKER in fitted.ids:
        # A level of its own needs the frame itself; thousands of bins share that one number.
        return Hypothesis(fitted, plain.chi2)
    fold, seam_parameters = folds(model.observed, N_FOLDS), slice(SEAM_FROM, fitted.n_nuisances)
    costs = np.zeros(len(fold))
    for k in range(N_FOLDS):
        held = fold == k
        if held.any():
            # Frames without a source say nothing of its level: then the fit to all frames judges.
            is_fair = shows_same_sources(model.observed, ~held)
            x = fitted.quadratic.solve(~held, FOLD_DAMPING, seam_parameters) if is_fair else fitted.x
            costs[held] = plain.costs(x)[held]
    return Hypothesis(fitted, costs)


def by_evidence(hypotheses: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses, likeliest first."""
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.evidence)


def posterior_probabilities(hypotheses: Sequence[Hypothesis], baseline: Hypothesis) -> Float64:
    """Return each hypothesis' probability (n,), if exactly one of them or the baseline is right.

    One that its bounds limit mimics another: it gets nothing where the first is not limited.
    """
    evidence = np.array([*(hypothesis.evidence for hypothesis in hypotheses), baseline.evidence])
    mimics = [hypothesis.is_bound_limited and not hypotheses[0].is_bound_limited for hypothesis in hypotheses]
    evidence[:-1][mimics] = -math.inf
    weight = np.exp(evidence - evidence.max())
    return np.asarray(weight / weight.sum())[:-1]


def residual_fraction(hypothesis: Hypothesis, baseline: Hypothesis) -> float:
    """Return the share of the baseline's gap above the model's floor that a hypothesis leaves, 0 to 1."""
    gap = max(baseline.cv_mean_square - 1.0, 0.0)
    return min(max(hypothesis.cv_mean_square - 1.0, 0.0) / gap, 1.0) if gap > 0.0 else 0.0


def is_explained(model: LinearizedModel, hypothesis: Hypothesis, baseline: Hypothesis) -> bool:
    """Say whether one effect explains a gap: it leaves little beyond the error of its own form.

    Or it leaves hardly anything in pixels that showed the gap. Where the misfit of pixels is known, the
    effect must halve it. An effect that its bounds limit explains nothing.
    """
    if hypothesis.is_bound_limited:
        return False
    visible_misfit = baseline.pixel_misfit
    if visible_misfit > MAX_MISFIT_AT_FLOOR and math.isfinite(hypothesis.pixel_misfit):
        fraction_kept = (hypothesis.pixel_misfit - 1.0) / (visible_misfit - 1.0)
        if fraction_kept <= MAX_PIXEL_FRACTION:
            return True
        if fraction_kept > MAX_PIXEL_FRACTION_KEPT:
            return False
    return mean_square_beyond_form(model, hypothesis) - 1.0 <= MAX_RESIDUAL_FRACTION * max(
        baseline.cv_mean_square - 1.0, 0.0
    )
