"""The score test: how much of the gap each effect would close, from a few probe points of its parameters.

The frames are predicted at some probe points of an effect's parameters. The residual is interpolated linearly
between the baseline and these, r_0 + sum_k t_k (r_k - r_0), and along the derivatives with the nuisances. The
cost at the best t and nuisances is then a closed form. This is Rao's score test with the nuisances projected
out, with finite steps in place of derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.fit import Parameter, within_bounds
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.loss import HuberLoss
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.search.probe_points import (
    FAMILIES,
    N_PARTS,
    ProbeFamily,
    first_neutral_part,
    probe_points_about,
)

MIN_STEP = 0.05
"""The shortest first step of a fit, in distances of a probe point: at neutral some effects have no slope."""

MAX_STEP = 3.0
"""Largest extrapolation of a line, in distances of its probe point."""


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """The score of one effect: the share of the cost that it leaves, and what it changes where it is tried.

    `signature` (n, k) is the change of the residuals at its probe points, `steps` (k, p) is how far these lie
    from `origin`. `others` are the scores of the effect's other families, the best first.
    """

    id: str
    residual_fraction: float
    signature: Float64
    origin: dict[str, float]
    steps: Float64
    others: tuple[ScoreTest, ...] = ()

    @property
    def families(self) -> tuple[ScoreTest, ...]:
        """The scores of all of the effect's families, the best first."""
        return (self, *self.others)

    @property
    def is_seen(self) -> bool:
        """True if the effect changes any bin at all."""
        return any(score.signature.any() for score in self.families)

    def step_limits(self) -> list[tuple[float, float]]:
        """Return the limits of each step within the parameters' bounds, and within `MAX_STEP` steps."""
        start = np.array(list(self.origin.values()))
        return [_step_limits(REGISTRY[self.id].parameters, start, step) for step in self.steps]

    def parameters_along(self, t: Float64) -> dict[str, float]:
        """Return the parameters after steps t (k,) towards the probe points, at least `MIN_STEP`."""
        steps = t if np.abs(t).max() > MIN_STEP else np.full(len(t), MIN_STEP)
        parameters = REGISTRY[self.id].parameters
        # On a bound by rounding is beyond it.
        values = within_bounds(parameters, np.array(list(self.origin.values())) + steps @ self.steps)
        return dict(zip((parameter.name for parameter in parameters), values.tolist(), strict=True))


def score_effects(model: LinearizedModel, baseline: Refit, ids: Sequence[str]) -> list[ScoreTest]:
    """Return the scores of effects added to a fit without any, those that leave least first."""
    r = model.residuals(model.lights(baseline.nuisance, {}))
    scores = [_score_effect(model, baseline, r, name) for name in ids]
    return sorted(scores, key=lambda score: score.residual_fraction)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A family that was predicted: `columns` (n, k) are the changes of the residuals at its probe points."""

    family: ProbeFamily
    columns: Float64


def _score_effect(model: LinearizedModel, baseline: Refit, r: Float64, name: str) -> ScoreTest:
    """Return the score of an effect's best family; of an effect with several parts, of the best for each.

    All start from the values that the setup states. Parts that it states stay, and further ones are sought.
    """
    origin, families, n_parts = model.stated_values(name), FAMILIES[name], N_PARTS.get(name, 1)
    first = first_neutral_part(name, origin)
    if n_parts == 1 and origin != REGISTRY[name].neutral:
        # Its stated shape may be right.
        families = (*(ProbeFamily(family.probe_points) for family in families if family.shape), *families)
    trials = [_try_family(model, baseline, r, name, origin, family, first) for family in families]
    chosen: list[_Trial] = []
    best: ScoreTest | None = None
    for _ in range(first, n_parts + 1):
        tried = [
            (_score_families(baseline, r, name, origin, [*chosen, trial], first), trial) for trial in trials
        ]
        tried.sort(key=lambda pair: pair[0].residual_fraction)
        (score, trial), *others = tried
        # A further part, such as a second patch, must remove a tenth of the cost.
        if best is not None and score.residual_fraction > 0.9 * best.residual_fraction:
            break
        best, chosen = replace(score, others=tuple(other for other, _ in others)), [*chosen, trial]
    assert best is not None
    return best


def _try_family(
    model: LinearizedModel,
    baseline: Refit,
    r: Float64,
    name: str,
    origin: Values,
    family: ProbeFamily,
    part: int,
) -> _Trial:
    """Predict a family's probe points about an origin, those of one part if the effect has several."""
    family_of_part = family.for_part(part)
    shaped, columns = {**origin, **family_of_part.shape}, []
    for point in probe_points_about(name, origin, family_of_part.probe_points):
        lights = model.lights(baseline.nuisance, {name: {**shaped, **point}})
        columns.append(model.residuals(lights) - r)
    return _Trial(family, np.column_stack(columns))


def _score_families(
    baseline: Refit, r: Float64, name: str, origin: Values, trials: Sequence[_Trial], first: int
) -> ScoreTest:
    """Return the score of families taken together, one for each part from the `first` on."""
    families = [trial.family.for_part(number) for number, trial in enumerate(trials, first)]
    columns = np.hstack([trial.columns for trial in trials])
    shaped = dict(origin)
    for family in families:
        shaped.update(family.shape)
    points = probe_points_about(name, origin, [point for family in families for point in family.probe_points])
    steps = np.array([[point.get(key, value) - value for key, value in shaped.items()] for point in points])
    score = ScoreTest(name, 1.0, columns, shaped, steps)
    quadratic = with_columns(baseline, r, columns, score.step_limits())
    # The share of the cost left at the best steps along columns (n, k) and the nuisances.
    return replace(score, residual_fraction=quadratic.cost(quadratic.solve()) / quadratic.chi2)


def with_columns(
    baseline: Refit, r: Float64, columns: Float64, limits: Sequence[tuple[float, float]]
) -> Quadratic:
    """Return the cost of residuals r (n,) along the baseline's parameters and further columns (n, k)."""
    t = [
        Parameter(f"t_{k}", "", 0.0, np.inf, low, high, 1e-3 * (high - low))
        for k, (low, high) in enumerate(limits)
    ]
    weighted, weighted_r = baseline.weights[:, np.newaxis] * columns, baseline.weights * r
    across = baseline.jacobian.T @ weighted
    return Quadratic(
        (*baseline.quadratic.parameters, *t),
        np.concatenate([baseline.x, np.zeros(len(t))]),
        np.block([[baseline.quadratic.information, across], [across.T, columns.T @ weighted]]),
        -np.concatenate([baseline.jacobian.T @ weighted_r, columns.T @ weighted_r]),
        float(weighted_r @ r),
        HuberLoss.about(r).prior_weight,
    )


def _step_limits(parameters: Sequence[Parameter], start: Float64, step: Float64) -> tuple[float, float]:
    """Return the numbers of steps (p,), back and forth, within the parameters' bounds and `MAX_STEP`."""
    low, high = -MAX_STEP, MAX_STEP
    for parameter, value, by in zip(parameters, start, step, strict=True):
        if by != 0.0:
            ends = sorted(((parameter.lower - value) / by, (parameter.upper - value) / by))
            low, high = max(low, ends[0]), min(high, ends[1])
    return low, high
