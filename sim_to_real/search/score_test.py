"""The first look at every candidate: how much of the gap it would close, from a few places of its parameters.

The frames are predicted at some places of an effect's parameters. Between the baseline and each of them the
residual is taken to go straight, r_0 + sum_k t_k (r_k - r_0), and nuisances along their derivatives; what is
left at the best t and nuisances is a closed form. It is the score test with the nuisances projected out, for
effects that are too large for a derivative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.fit import Parameter, within_bounds
from sim_to_real.fit.gauss_newton import FLICKER, Refit, own_levels
from sim_to_real.fit.linearized_model import Expected, Passed
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.fit.trend import CHANGING, LEAST_RANGE, Change, Driver
from sim_to_real.search.probe_points import FAMILIES, PARTS, Family, about, free_part

LEAST = 0.05
"""A fit starts at least so far, of a place's distance, from neutral: some effects have no slope there."""

FARTHEST = 3.0
"""How far beyond its place a straight line is followed; twice as far at the ends of what changes."""

STARTS = 3
"""So many of an effect's families a fit may start from."""

ANOTHER_PART = 0.9
"""One more of an effect's alike parts must leave less than this share of what is left without it."""


@dataclass(frozen=True, eq=False)
class Screened:
    """A candidate after the first look: the share of the cost that is left, and where a fit should start.

    `signature` (n, k) is what its places do to the residuals, `steps` (k, p) how far they lie from `origin`.
    `others` are the looks at the effect's other families, the best first.
    """

    id: str
    left: float
    start: dict[str, float]
    signature: Float64
    origin: dict[str, float]
    steps: Float64
    others: tuple[Screened, ...] = ()

    @property
    def families(self) -> tuple[Screened, ...]:
        """The looks at all of the effect's families, the best first."""
        return (self, *self.others)

    @property
    def n_parameters(self) -> int:
        """How many numbers a fit has: of arc_flicker the levels of frames that show it, about their mean."""
        if self.id == FLICKER:
            return max(int(np.any(self.signature, axis=0).sum()) - 1, 1)
        return len(REGISTRY[self.id].parameters)

    def reaches(self, farthest: float = FARTHEST) -> list[tuple[float, float]]:
        """Return how far along each place one may go within the parameters' bounds, and no farther."""
        start = np.array(list(self.origin.values()))
        return [_reach(REGISTRY[self.id].parameters, start, step, farthest) for step in self.steps]

    def along(self, t: Float64) -> dict[str, float]:
        """Return parameters so far along the places (k,), but not at the origin."""
        return self.moved((t if np.abs(t).max() > LEAST else np.full(len(t), LEAST)) @ self.steps)

    def moved(self, by: Float64) -> dict[str, float]:
        """Return parameters by so much (p,) from the origin, within their bounds."""
        parameters = REGISTRY[self.id].parameters
        # On a bound by rounding is beyond it.
        found = within_bounds(parameters, np.array(list(self.origin.values())) + by)
        return dict(zip((of.name for of in parameters), found.tolist(), strict=True))

    @property
    def starts(self) -> list[dict[str, float]]:
        """Where fits should start: light that is not rendered has valleys side by side."""
        return [one.start for one in self.families[:STARTS]]


@dataclass(frozen=True, eq=False)
class ScreenedChange:
    """An effect that changes, after the first look: what is left, where its middle starts, and its change."""

    left: float
    start: dict[str, float]
    change: Change


def screen(expected: Expected, baseline: Refit, ids: Sequence[str]) -> list[Screened]:
    """Return candidates to add to the baseline's effects, those that leave least first."""
    r = expected.residuals(_rendered(expected, baseline, baseline.effects))
    found = [_tried(expected, baseline, r, name) for name in ids]
    return sorted(found, key=lambda screened: screened.left)


def seen_from(baseline: Refit, screened: Sequence[Screened]) -> list[Screened]:
    """Return what effects would leave beside another baseline's, if their places did there what they do here.

    Nothing is predicted anew for that, and where a fit should start is not found anew.
    """

    def left(one: Screened) -> float:
        return along(baseline, baseline.residuals, one.signature, one.reaches())[0]

    return [
        replace(one, left=min(left(family) for family in one.families))
        for one in screened
        if one.id not in baseline.ids
    ]


def screen_changes(expected: Expected, baseline: Refit, screened: Sequence[Screened]) -> list[ScreenedChange]:
    """Return effects that may change, by each driver, those first that leave least.

    The baseline is the one that they were looked at from. With the driver's share u from -1 to 1, what places
    do goes in each frame as t_k (1 - u) / 2 + t'_k (1 + u) / 2: a straight line again, and t_k and t'_k are
    how far the ends go. A driver that stays drives nothing.
    """
    r = expected.residuals(_rendered(expected, baseline, baseline.effects))
    found = []
    for one in screened:
        for driver in Driver if one.id in CHANGING else ():
            change = Change.of(expected.observed, one.id, driver)
            if change.half > LEAST_RANGE:
                u = change.shares(expected.observed)[:, np.newaxis]
                looks = [_changed(baseline, r, of, change, u) for of in one.families]
                found.append(min(looks, key=lambda look: look.left))
    return sorted(found, key=lambda look: look.left)


def _changed(baseline: Refit, r: Float64, one: Screened, change: Change, u: Float64) -> ScreenedChange:
    """Let one family's places change with u (n, 1) of the residuals."""
    ends = np.hstack([0.5 * (1.0 - u) * one.signature, 0.5 * (1.0 + u) * one.signature])
    left, t = along(baseline, r, ends, 2 * one.reaches(2.0 * FARTHEST))
    low, high = t.reshape(2, -1) @ one.steps
    return ScreenedChange(
        left, one.moved(0.5 * (low + high)), replace(change, by=tuple((0.5 * (high - low)).tolist()))
    )


def screen_flicker(expected: Expected, baseline: Refit) -> Screened:
    """Return the look at arc_flicker: each frame has an arc level of its own, a column each."""
    levels, neutral = own_levels(expected, baseline.jacobian[:, 0]), dict(REGISTRY[FLICKER].neutral)
    one = Screened(FLICKER, 1.0, neutral, levels, neutral, np.zeros((levels.shape[1], len(neutral))))
    return replace(one, left=along(baseline, baseline.residuals, levels, one.reaches())[0])


def _rendered(expected: Expected, baseline: Refit, effects: Mapping[str, Values]) -> list[Passed]:
    """Return the light at the baseline's nuisances with other effects."""
    by = np.zeros((len(baseline.arc_ln), baseline.n_nuisances))
    by[:, 0] = baseline.arc_ln
    passed = expected.passed(baseline.nuisance, effects, baseline.change)
    return [expected.moved(*of) for of in zip(expected.observed.frames, passed, by, strict=True)]


@dataclass(frozen=True, eq=False)
class _Look:
    """A family's places as tried: `columns` (n, k) by which they change the residuals."""

    family: Family
    columns: Float64


def _tried(expected: Expected, baseline: Refit, r: Float64, name: str) -> Screened:
    """Look at the best of an effect's families; of an effect with alike parts, at the best for each part.

    All start from what the setup states of it: parts that it states stand, and others are sought.
    """
    origin, families, n_parts = expected.stated(name), FAMILIES[name], PARTS.get(name, 1)
    first = free_part(name, origin)
    if n_parts == 1 and origin != REGISTRY[name].neutral:
        # Its stated shape may be right.
        families = (*(Family(one.places) for one in families if one.shape), *families)
    looks = [_look(expected, baseline, r, name, origin, family, first) for family in families]
    chosen: list[_Look] = []
    best: Screened | None = None
    for _ in range(first, n_parts + 1):
        tried = [(_solved(baseline, r, name, origin, [*chosen, look], first), look) for look in looks]
        tried.sort(key=lambda pair: pair[0].left)
        (screened, look), *others = tried
        if best is not None and screened.left > ANOTHER_PART * best.left:
            break
        best, chosen = replace(screened, others=tuple(other for other, _ in others)), [*chosen, look]
    assert best is not None
    return best


def _look(
    expected: Expected, baseline: Refit, r: Float64, name: str, origin: Values, family: Family, part: int
) -> _Look:
    """Try a family's places about an origin, of an effect with alike parts on one of them."""
    of_part = family.of_part(part)
    shaped, columns = {**origin, **of_part.shape}, []
    for place in about(name, origin, of_part.places):
        passed = _rendered(expected, baseline, {**baseline.effects, name: {**shaped, **place}})
        columns.append(expected.residuals(passed) - r)
    return _Look(family, np.column_stack(columns))


def _solved(
    baseline: Refit, r: Float64, name: str, origin: Values, looks: Sequence[_Look], first: int
) -> Screened:
    """Go along the places of all looks, and along the nuisances, to where least is left.

    The looks are those at alike parts from the `first` on.
    """
    families = [look.family.of_part(number) for number, look in enumerate(looks, first)]
    columns = np.hstack([look.columns for look in looks])
    shaped = dict(origin)
    for family in families:
        shaped.update(family.shape)
    places = about(name, origin, [place for family in families for place in family.places])
    steps = np.array([[place.get(key, value) - value for key, value in shaped.items()] for place in places])
    one = Screened(name, 1.0, {}, columns, shaped, steps)
    left, t = along(baseline, r, columns, one.reaches())
    return replace(one, left=left, start=one.along(t))


def along(
    baseline: Refit, r: Float64, columns: Float64, reach: Sequence[tuple[float, float]]
) -> tuple[float, Float64]:
    """Return what is left, as a share, at the best t (k,) along columns (n, k) and the nuisances; and t."""
    quadratic = with_columns(baseline, r, columns, reach)
    x = quadratic.solve()
    return float(quadratic.costs(x).sum() / quadratic.chi2.sum()), x[len(baseline.x) :]


def with_columns(
    baseline: Refit, r: Float64, columns: Float64, reach: Sequence[tuple[float, float]]
) -> Quadratic:
    """Return the cost of residuals r (n,) along what the baseline was fitted by and columns (n, k)."""
    t = [
        Parameter(f"t_{k}", "", 0.0, np.inf, low, high, 1e-3 * (high - low))
        for k, (low, high) in enumerate(reach)
    ]
    return Quadratic.of(
        (*baseline.quadratic.parameters, *t),
        np.concatenate([baseline.x, np.zeros(len(t))]),
        r,
        np.hstack([baseline.jacobian, columns]),
        baseline.weights,
        baseline.quadratic.counts,
    )


def _reach(
    parameters: Sequence[Parameter], start: Float64, step: Float64, farthest: float
) -> tuple[float, float]:
    """Return how far along a step (p,) one may go, backward and forward, within the parameters' bounds."""
    low, high = -farthest, farthest
    for parameter, at, by in zip(parameters, start, step, strict=True):
        if by != 0.0:
            ends = sorted(((parameter.lower - at) / by, (parameter.upper - at) / by))
            low, high = max(low, ends[0]), min(high, ends[1])
    return low, high
