"""The score test: how much of the gap each effect would close, from a few probe points of its parameters.

The frames are predicted at some probe points of an effect's parameters. The residual is interpolated linearly
between the baseline and these, r_0 + sum_k t_k (r_k - r_0), and along the derivatives with the nuisances. The
cost at the best t and nuisances is then a closed form. This is Rao's score test with the nuisances projected
out, with finite steps in place of derivatives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.effects.optics import PATCHES
from noise_model.fit import Parameter, within_bounds
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import INTERREFLECTION, LinearizedModel
from sim_to_real.fit.loss import HuberLoss
from sim_to_real.fit.quadratic import Quadratic


@dataclass(frozen=True)
class ProbeFamily:
    """Probe points of an effect that are combined; the values of `shape` hold for all of them."""

    probe_points: tuple[Values, ...]
    shape: Values = field(default_factory=dict)

    def for_part(self, number: int) -> "ProbeFamily":
        """Return the family for another part of an effect with several; the first one is 1."""

        def renamed(values: Values) -> Values:
            return {key.replace("_1", f"_{number}"): value for key, value in values.items()}

        return ProbeFamily(tuple(renamed(point) for point in self.probe_points), renamed(self.shape))


def _each(*probe_points: Values) -> tuple[ProbeFamily, ...]:
    return tuple(ProbeFamily((point,)) for point in probe_points)


def _drifts() -> tuple[ProbeFamily, ...]:
    settling = (ProbeFamily(({"rate_per_s": 0.2 / min(s, 2.0)},), {"settle_s": s}) for s in (0.4, 1.5, 100.0))
    swinging = (
        ProbeFamily(({"swing_sin": 0.1}, {"swing_cos": 0.1}), {"swing_hz": hz})
        for hz in (0.3, 0.5, 0.8, 1.3, 2.1, 3.4)
    )
    return (*settling, *swinging)


def _patches() -> tuple[ProbeFamily, ...]:
    small = [(0.12, u, v) for u in (-0.7, -0.42, -0.14, 0.14, 0.42, 0.7) for v in (-0.45, -0.15, 0.15, 0.45)]
    wide = [(0.3, u, v) for u in (-0.5, 0.0, 0.5) for v in (-0.3, 0.3)]
    return tuple(
        ProbeFamily(({"dimming_1": 0.2}, {"scatter_1": 0.1}), {"u_1": u, "v_1": v, "radius_1": radius})
        for radius, u, v in (*small, *wide)
    )


def _ending(key: str, neutral: float, shape: Values) -> ProbeFamily:
    """Return a family of light that ends at an edge, which is not linear between that edge and none.

    A fit starts from the edge itself, whatever step fits the residual best.
    """
    return ProbeFamily(({key: neutral},), shape)


GHOSTS_ACROSS = tuple(round(sign * 0.035 * n, 3) for n in range(1, 19) for sign in (1, -1))
"""Distances from the stripe at which its ghost is searched, in half diagonals: a stripe's usual 2 sigma
apart.
"""

FAMILIES: Mapping[str, tuple[ProbeFamily, ...]] = {
    "arc_length": _each({"height_mm": 0.7}, {"height_mm": -0.7}),
    "arc_deflection": (
        ProbeFamily(({"x_mm": 0.7}, {"y_mm": 0.7})),
        ProbeFamily(({"x_mm": -0.7}, {"y_mm": -0.7})),
    ),
    "arc_radius": _each({"radius_ratio": 1.3}, {"radius_ratio": 0.75}),
    "argon_line_leak": tuple(
        ProbeFamily(({"line_width_nm": width},), {"edge_od_per_nm": edge})
        for width in (3.0, 30.0)
        for edge in (0.0, 0.5)
    ),
    "laser_power_drift": _drifts(),
    "uneven_fan": (
        ProbeFamily(({"slope": 0.2}, {"curvature": 0.2})),
        *_each({"half_angle_deg": 5.0}),
        *(
            _ending("slope", 0.0, {"half_angle_deg": half_deg})
            for half_deg in (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0)
        ),
    ),
    "stripe_profile": (
        ProbeFamily(({"width_ratio": 1.1}, {"exponent": 2.3})),
        *_each({"width_ratio": 0.8}, {"width_ratio": 1.4}, {"exponent": 3.5}, {"exponent": 1.6}),
    ),
    "ambient_light": tuple(
        ProbeFamily(({"level_e": 300.0},), {"from_left": side}) for side in (0.0, 0.5, -0.5)
    ),
    "wrong_material": tuple(
        ProbeFamily(places, {"stripe_share": share})
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
        ProbeFamily(({"anisotropy": size},), {"marks_deg": deg})
        for deg in (0.0, 45.0)
        for size in (0.4, -0.4)
    ),
    "plate_outline": (
        *_each({"left_mm": 12.0}, {"right_mm": 12.0}),
        *(
            _ending(other, REGISTRY["plate_outline"].neutral["left_mm"], {side: reach_mm})
            for side, other in (("left_mm", "right_mm"), ("right_mm", "left_mm"))
            for reach_mm in (4.0, 7.0, 10.0, 12.5, 15.0, 17.5, 20.0)
        ),
    ),
    "hot_metal_glow": tuple(
        ProbeFamily(({"peak_e": 2e4},), {"length_mm": length, "arc_off_share": share})
        for length in (5.0, 10.0, 20.0, 40.0)
        for share in (0.0, 1.0)
    ),
    "fume": tuple(
        ProbeFamily(({"extinction_per_m": 0.5},), {"scatter": scatter, "gathered_per_mm": gathered})
        for gathered in (0.0, 0.03)
        for scatter in (0.0, 0.03, 0.3, 3.0)
    ),
    "dirty_window": _patches(),
    "ghost_stripe": tuple(
        ProbeFamily(({"strength": 0.2},), {"across": across, "along": 0.0}) for across in GHOSTS_ACROSS
    ),
    "filter_shift": tuple(
        ProbeFamily(({"shift_share": 1.0},), {"tilt_right_deg": right_deg, "tilt_down_deg": down_deg})
        for right_deg in (0.0, 5.0, -5.0)
        for down_deg in (0.0, 5.0, -5.0)
    ),
    "vignetting": (ProbeFamily(({"loss": 0.1}, {"corner_loss": 0.1})),),
    "defocus": _each({"sigma_px": 1.5}, {"sigma_px": 4.0}),
    "veiling_glare": tuple(
        ProbeFamily(({"share": 0.05},), {"spread": spread}) for spread in (0.1, 0.3, 0.8, 3.0)
    ),
    "exposure_drift": _drifts(),
    "blooming": (
        *(ProbeFamily(({"spill": 0.3},), {"reach_px": reach}) for reach in (5.0, 30.0, 150.0)),
        ProbeFamily(({"column_share": 0.5},)),
    ),
    "gamma": (ProbeFamily(({"gamma": 1.1}, {"bend": 0.1})), *_each({"gamma": 0.85}, {"gamma": 1.2})),
    "black_level": _each({"offset_dn": 2.0}),
    "hand_eye": (
        ProbeFamily(
            (*({f"rot_{axis}_deg": 0.1} for axis in "xyz"), *({f"move_{axis}_mm": 0.3} for axis in "xyz"))
        ),
    ),
    "surface_tilt": (ProbeFamily(({"roll_deg": 0.5}, {"pitch_deg": 0.5})),),
    "lens_distortion": (ProbeFamily(({"k1": 0.1}, {"k2": 2.0}, {"p1": 0.003}, {"p2": 0.003})),),
    "pose_delay": _each(*({"delay_s": sign * delay} for delay in (0.01, 0.05) for sign in (1.0, -1.0))),
}
"""The families of each effect that changes a frame's mean; random effects show in its scatter instead."""

N_PARTS: Mapping[str, int] = {"dirty_window": len(PATCHES)}
"""Number of parts of an effect with several; they are searched one after another."""

EXPENSIVE: Mapping[str, Values] = {INTERREFLECTION: {"albedo": 0.35}}
"""Effects that take longer than all others together, tried last; and where their fit starts."""


def first_neutral_part(name: str, origin: Values) -> int:
    """Return the number of an effect's first part that its parameters leave neutral, or of the last part.

    It is 1 for an effect that has no parts.
    """
    neutral, n_parts = REGISTRY[name].neutral, N_PARTS.get(name, 1)
    for number in range(1, n_parts):
        if all(origin[key] == neutral[key] for key in neutral if key.endswith(f"_{number}")):
            return number
    return n_parts


def probe_points_about(name: str, origin: Values, probe_points: Sequence[Values]) -> list[dict[str, float]]:
    """Return probe points shifted: as far from `origin` as they were from neutral.

    A value that would pass a bound goes in the other direction.
    """
    parameters = {parameter.name: parameter for parameter in REGISTRY[name].parameters}

    def moved(key: str, value: float) -> float:
        step = value - parameters[key].start
        there = origin[key] + step
        return there if parameters[key].lower <= there <= parameters[key].upper else origin[key] - step

    return [{key: moved(key, value) for key, value in point.items()} for point in probe_points]


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
    others: "tuple[ScoreTest, ...]" = ()

    @property
    def families(self) -> "tuple[ScoreTest, ...]":
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
    r = model.residuals_at(baseline.nuisance, {})
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
    shaped = {**origin, **family_of_part.shape}
    columns = [
        model.residuals_at(baseline.nuisance, {name: {**shaped, **point}}) - r
        for point in probe_points_about(name, origin, family_of_part.probe_points)
    ]
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
