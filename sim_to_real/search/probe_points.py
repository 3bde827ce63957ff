"""Probe points of the score test for each effect of the catalogue, in families."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from noise_model.effects import REGISTRY, Values
from noise_model.effects.optics import PATCHES
from sim_to_real.fit.linearized_model import INTERREFLECTION


@dataclass(frozen=True)
class ProbeFamily:
    """Probe points of an effect that are combined; the values of `shape` hold for all of them."""

    probe_points: tuple[Values, ...]
    shape: Values = field(default_factory=dict)

    def for_part(self, number: int) -> ProbeFamily:
        """Return the family for another part of an effect with several; the first one is 1."""

        def renamed(values: Values) -> Values:
            return {key.replace("_1", f"_{number}"): value for key, value in values.items()}

        return ProbeFamily(tuple(renamed(point) for point in self.probe_points), renamed(self.shape))


def _each(*probe_points: Values) -> tuple[ProbeFamily, ...]:
    """Return a family for each probe point."""
    return tuple(ProbeFamily((point,)) for point in probe_points)


def _drifts() -> tuple[ProbeFamily, ...]:
    settling = (ProbeFamily(({"rate_per_s": 0.2 / min(s, 2.0)},), {"settle_s": s}) for s in (0.4, 1.5, 100.0))
    swinging = (
        ProbeFamily(({"swing_sin": 0.1}, {"swing_cos": 0.1}), {"swing_hz": hz})
        for hz in (0.3, 0.5, 0.8, 1.3, 2.1, 3.4)
    )
    return (*settling, *swinging)


def _patches() -> tuple[ProbeFamily, ...]:
    """Patches of two sizes all over the image."""
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
    "filter_shift": _each({"shift_share": 0.5}, {"shift_share": 2.0}),
    "vignetting": (ProbeFamily(({"loss": 0.1}, {"corner_loss": 0.1})),),
    "defocus": _each({"sigma_px": 1.5}, {"sigma_px": 4.0}),
    "veiling_glare": tuple(
        ProbeFamily(({"share": 0.05},), {"spread": spread}) for spread in (0.1, 0.3, 0.8, 3.0)
    ),
    "exposure_drift": _drifts(),
    "blooming": tuple(ProbeFamily(({"spill": 0.3},), {"reach_px": reach}) for reach in (5.0, 30.0, 150.0)),
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
