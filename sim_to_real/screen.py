"""The first look at every candidate: how much of the gap it would close, from a few places of its parameters.

The frames are predicted at some places of an effect's parameters. Between the baseline and each of them the
residual is taken to go straight, r_0 + sum_k t_k (r_k - r_0), and nuisances along their derivatives; what is
left at the best t and nuisances is a closed form. It is the score test with the nuisances projected out, for
effects that are too large for a derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from noise_model.effects import REGISTRY, Values
from noise_model.effects.optics import PATCHES
from noise_model.fit import Parameter, within_bounds
from noise_model.frames import Float64
from sim_to_real.change import CHANGING, LEAST_RANGE, Change, Driver
from sim_to_real.expected import BOUNCING, Expected, Passed
from sim_to_real.quadratic import Quadratic
from sim_to_real.refit import Refit

LEAST = 0.05
"""A fit starts at least so far, of a place's distance, from neutral: some effects have no slope there."""

FARTHEST = 3.0
"""How far beyond its place a straight line is followed; twice as far at the ends of what changes."""


@dataclass(frozen=True)
class Family:
    """Places of an effect's parameters that are tried together: `shape` holds for all of them."""

    places: tuple[Values, ...]
    shape: Values = field(default_factory=dict)


def _each(*places: Values) -> tuple[Family, ...]:
    """Return a family for each place."""
    return tuple(Family((place,)) for place in places)


def _drifts() -> tuple[Family, ...]:
    settling = (Family(({"rate_per_s": 0.2 / min(s, 2.0)},), {"settle_s": s}) for s in (0.4, 1.5, 100.0))
    swinging = (
        Family(({"swing_sin": 0.1}, {"swing_cos": 0.1}), {"swing_hz": hz})
        for hz in (0.3, 0.5, 0.8, 1.3, 2.1, 3.4)
    )
    return (*settling, *swinging)


def _patches() -> tuple[Family, ...]:
    """Patches of two sizes all over the image."""
    small = [(0.12, u, v) for u in (-0.7, -0.42, -0.14, 0.14, 0.42, 0.7) for v in (-0.45, -0.15, 0.15, 0.45)]
    wide = [(0.3, u, v) for u in (-0.5, 0.0, 0.5) for v in (-0.3, 0.3)]
    return tuple(
        Family(({"dimming_1": 0.2}, {"scatter_1": 0.1}), {"u_1": u, "v_1": v, "radius_1": radius})
        for radius, u, v in (*small, *wide)
    )


FAMILIES: Mapping[str, tuple[Family, ...]] = {
    "arc_length": _each({"height_mm": 0.7}, {"height_mm": -0.7}),
    "arc_deflection": (Family(({"x_mm": 0.7}, {"y_mm": 0.7})), Family(({"x_mm": -0.7}, {"y_mm": -0.7}))),
    "arc_radius": _each({"radius_ratio": 1.3}, {"radius_ratio": 0.75}),
    "argon_line_leak": tuple(
        Family(({"line_width_nm": width},), {"edge_od_per_nm": edge})
        for width in (3.0, 30.0)
        for edge in (0.0, 0.5)
    ),
    "laser_power_drift": _drifts(),
    "wrong_material": tuple(
        Family(places, {"stripe_share": share})
        for share in (0.0, 1.0)
        for places in (
            ({"kappa_diff_ln": 0.3}, {"kappa_spec_ln": 0.3}),
            ({"kappa_diff_ln": 3.0, "kappa_spec_ln": -0.7},),
            ({"kappa_diff_ln": -3.0, "kappa_spec_ln": 0.7},),
            ({"kappa_diff_ln": 1.0},),
            ({"kappa_diff_ln": -1.0},),
            ({"kappa_spec_ln": 1.0},),
            ({"kappa_spec_ln": -1.0},),
        )
    ),
    "roughness_change": _each({"c2_ln": 0.3}, {"c2_ln": -0.3}, {"c2_ln": 1.2}, {"c2_ln": -1.2}),
    "brdf_tail": _each({"tail": 0.15}, {"tail": 0.8}),
    "rolling_marks": tuple(
        Family(({"anisotropy": size},), {"marks_deg": deg}) for deg in (0.0, 45.0) for size in (0.4, -0.4)
    ),
    "hot_metal_glow": tuple(
        Family(({"peak_e": 2e4},), {"length_mm": length, "arc_off_share": share})
        for length in (5.0, 10.0, 20.0, 40.0)
        for share in (0.0, 1.0)
    ),
    "fume": tuple(
        Family(({"extinction_per_m": 0.5},), {"scatter": scatter, "gathered_per_mm": gathered})
        for gathered in (0.0, 0.03)
        for scatter in (0.0, 0.03, 0.3, 3.0)
    ),
    "dirty_window": _patches(),
    "filter_shift": _each({"shift_share": 0.5}, {"shift_share": 2.0}),
    "vignetting": (Family(({"loss": 0.1}, {"corner_loss": 0.1})),),
    "defocus": _each({"sigma_px": 1.5}, {"sigma_px": 4.0}),
    "veiling_glare": tuple(Family(({"share": 0.05},), {"spread": spread}) for spread in (0.1, 0.3, 0.8, 3.0)),
    "exposure_drift": _drifts(),
    "blooming": tuple(Family(({"spill": 0.3},), {"reach_px": reach}) for reach in (5.0, 30.0, 150.0)),
    "gamma": (Family(({"gamma": 1.1}, {"bend": 0.1})), *_each({"gamma": 0.85}, {"gamma": 1.2})),
    "black_level": _each({"offset_dn": 2.0}),
    "hand_eye": (
        Family(
            (
                *({f"rot_{axis}_deg": 0.1} for axis in "xyz"),
                *({f"move_{axis}_mm": 0.3} for axis in "xyz"),
            )
        ),
    ),
    "surface_tilt": (Family(({"roll_deg": 0.5}, {"pitch_deg": 0.5})),),
    "lens_distortion": (Family(({"k1": 0.1}, {"k2": 2.0}, {"p1": 0.003}, {"p2": 0.003})),),
    "pose_delay": _each(*({"delay_s": sign * delay} for delay in (0.01, 0.05) for sign in (1.0, -1.0))),
}
"""Where each effect that changes a frame's mean is tried; the random ones show in its scatter."""

PARTS: Mapping[str, int] = {"dirty_window": len(PATCHES)}
"""Effects of several alike parts: those beside the first are sought one after another."""

STARTS = 3
"""So many of an effect's families a fit may start from."""

ANOTHER_PART = 0.9
"""One more of them must leave less than this share of what is left without it."""

DEAR: Mapping[str, Values] = {BOUNCING: {"albedo": 0.35}}
"""Effects that take longer than all others together, and where their fit starts: tried if no other does."""


def size(effects: Mapping[str, Values], stated: Callable[[str], Values]) -> float:
    """Return how far the farthest of some effects is from where it is `stated`, in its prior's sigmas.

    That is by the parameters of which its places are made: where an effect is tried, and not in which shape.
    """
    origins = {name: stated(name) for name in effects}
    return max(
        abs(effects[name][parameter.name] - origins[name][parameter.name]) / parameter.prior_sigma
        for name in effects
        for parameter in REGISTRY[name].parameters
        if name not in FAMILIES or parameter.name in _placed(name)
    )


def _placed(name: str) -> set[str]:
    """Return the parameters of which an effect's places are made, those of all its alike parts."""
    numbers = range(1, PARTS.get(name, 1) + 1)
    return {key for n in numbers for of in FAMILIES[name] for place in _part(of, n).places for key in place}


TRIFLE = 0.1
"""An effect of a smaller share of its prior's sigma hardly is one."""


def is_trifle(effects: Mapping[str, Values], stated: Callable[[str], Values]) -> bool:
    """Say whether effects hardly differ from what is `stated` of them."""
    return size(effects, stated) < TRIFLE


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
    def starts(self) -> list[dict[str, float]]:
        """Where fits should start: light that is not rendered has valleys side by side."""
        return [one.start for one in (self, *self.others[: STARTS - 1])]


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
        return along(baseline, baseline.residuals, one.signature, _reaches(one))[0]

    return [
        replace(one, left=min(left(family) for family in (one, *one.others)))
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
                looks = [_changed(baseline, r, of, change, u) for of in (one, *one.others)]
                found.append(min(looks, key=lambda look: look.left))
    return sorted(found, key=lambda look: look.left)


def _changed(baseline: Refit, r: Float64, one: Screened, change: Change, u: Float64) -> ScreenedChange:
    """Let one family's places change with u (n, 1) of the residuals."""
    ends = np.hstack([0.5 * (1.0 - u) * one.signature, 0.5 * (1.0 + u) * one.signature])
    left, t = along(baseline, r, ends, 2 * _reaches(one, 2.0 * FARTHEST))
    low, high = t.reshape(2, -1) @ one.steps
    start = _within(one.id, np.array(list(one.origin.values())) + 0.5 * (low + high))
    return ScreenedChange(left, start, replace(change, by=tuple((0.5 * (high - low)).tolist())))


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


def _part(family: Family, number: int) -> Family:
    """Return a family as that of another of the effect's alike parts; the first one is 1."""

    def renamed(values: Values) -> Values:
        return {key.replace("_1", f"_{number}"): value for key, value in values.items()}

    return Family(tuple(renamed(place) for place in family.places), renamed(family.shape))


def _tried(expected: Expected, baseline: Refit, r: Float64, name: str) -> Screened:
    """Look at the best of an effect's families; of an effect with alike parts, at the best for each part.

    All start from what the setup states of it: parts that it states stand, and others are sought.
    """
    origin, families, n_parts = expected.stated(name), FAMILIES[name], PARTS.get(name, 1)
    first = _free_part(name, origin)
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


def _free_part(name: str, origin: Values) -> int:
    """Return which of an effect's alike parts is the first that its parameters leave neutral, or the last.

    Of an effect without such parts it is 1.
    """
    neutral, n_parts = REGISTRY[name].neutral, PARTS.get(name, 1)
    for number in range(1, n_parts):
        if all(origin[key] == neutral[key] for key in neutral if key.endswith(f"_{number}")):
            return number
    return n_parts


def _look(
    expected: Expected, baseline: Refit, r: Float64, name: str, origin: Values, family: Family, part: int
) -> _Look:
    """Try a family's places about an origin, of an effect with alike parts on one of them."""
    of_part = _part(family, part)
    shaped, columns = {**origin, **of_part.shape}, []
    for place in _from(name, origin, of_part.places):
        passed = _rendered(expected, baseline, {**baseline.effects, name: {**shaped, **place}})
        columns.append(expected.residuals(passed) - r)
    return _Look(family, np.column_stack(columns))


def _from(name: str, origin: Values, places: Sequence[Values]) -> list[dict[str, float]]:
    """Return places as far from where an effect's parameters are as they are from neutral.

    The other way round where that is beyond a bound.
    """
    of = {parameter.name: parameter for parameter in REGISTRY[name].parameters}

    def moved(key: str, value: float) -> float:
        step = value - of[key].start
        there = origin[key] + step
        return there if of[key].lower <= there <= of[key].upper else origin[key] - step

    return [{key: moved(key, value) for key, value in place.items()} for place in places]


def _solved(
    baseline: Refit, r: Float64, name: str, origin: Values, looks: Sequence[_Look], first: int
) -> Screened:
    """Go along the places of all looks, and along the nuisances, to where least is left.

    The looks are those at alike parts from the `first` on.
    """
    families = [_part(look.family, number) for number, look in enumerate(looks, first)]
    columns = np.hstack([look.columns for look in looks])
    shaped = dict(origin)
    for family in families:
        shaped.update(family.shape)
    places = _from(name, origin, [place for family in families for place in family.places])
    steps = np.array([[place.get(key, value) - value for key, value in shaped.items()] for place in places])
    one = Screened(name, 1.0, {}, columns, shaped, steps)
    left, t = along(baseline, r, columns, _reaches(one))
    if not np.abs(t).max() > LEAST:
        t = np.full(len(t), LEAST)
    return replace(one, left=left, start=_within(name, np.array(list(shaped.values())) + t @ steps))


def along(
    baseline: Refit, r: Float64, columns: Float64, reach: Sequence[tuple[float, float]]
) -> tuple[float, Float64]:
    """Return what is left, as a share, at the best t (k,) along columns (n, k) and the nuisances; and t."""
    t = [
        Parameter(f"t_{k}", "", 0.0, np.inf, low, high, 1e-3 * (high - low))
        for k, (low, high) in enumerate(reach)
    ]
    quadratic = Quadratic.of(
        (*baseline.quadratic.parameters, *t),
        np.concatenate([baseline.x, np.zeros(len(t))]),
        r,
        np.hstack([baseline.jacobian, columns]),
        baseline.weights,
        baseline.quadratic.counts,
    )
    x = quadratic.solve()
    return float(quadratic.costs(x).sum() / quadratic.chi2.sum()), x[len(baseline.x) :]


def _within(name: str, values: Float64) -> dict[str, float]:
    """Return an effect's parameters: on a bound by rounding is beyond it."""
    parameters = REGISTRY[name].parameters
    found = within_bounds(parameters, values)
    return dict(zip((of.name for of in parameters), found.tolist(), strict=True))


def _reaches(one: Screened, farthest: float = FARTHEST) -> list[tuple[float, float]]:
    """Return how far along each of an effect's places one may go."""
    start = np.array(list(one.origin.values()))
    return [_reach(REGISTRY[one.id].parameters, start, step, farthest) for step in one.steps]


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
