"""Where each effect of the catalogue is tried at the first look: places of its parameters, in families."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from noise_model.effects import REGISTRY, Values
from noise_model.effects.optics import PATCHES
from sim_to_real.fit.linearized_model import BOUNCING


@dataclass(frozen=True)
class Family:
    """Places of an effect's parameters that are tried together: `shape` holds for all of them."""

    places: tuple[Values, ...]
    shape: Values = field(default_factory=dict)

    def of_part(self, number: int) -> Family:
        """Return the family as that of another of the effect's alike parts; the first one is 1."""

        def renamed(values: Values) -> Values:
            return {key.replace("_1", f"_{number}"): value for key, value in values.items()}

        return Family(tuple(renamed(place) for place in self.places), renamed(self.shape))


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

DEAR: Mapping[str, Values] = {BOUNCING: {"albedo": 0.35}}
"""Effects that take longer than all others together, and where their fit starts: tried if no other does."""

TRIFLE = 0.1
"""An effect of a smaller share of its prior's sigma hardly is one."""


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
    return {key for n in numbers for of in FAMILIES[name] for place in of.of_part(n).places for key in place}


def is_trifle(effects: Mapping[str, Values], stated: Callable[[str], Values]) -> bool:
    """Say whether effects hardly differ from what is `stated` of them."""
    return size(effects, stated) < TRIFLE


def free_part(name: str, origin: Values) -> int:
    """Return which of an effect's alike parts is the first that its parameters leave neutral, or the last.

    Of an effect without such parts it is 1.
    """
    neutral, n_parts = REGISTRY[name].neutral, PARTS.get(name, 1)
    for number in range(1, n_parts):
        if all(origin[key] == neutral[key] for key in neutral if key.endswith(f"_{number}")):
            return number
    return n_parts


def about(name: str, origin: Values, places: Sequence[Values]) -> list[dict[str, float]]:
    """Return places as far from where an effect's parameters are as they are from neutral.

    The other way round where that is beyond a bound.
    """
    of = {parameter.name: parameter for parameter in REGISTRY[name].parameters}

    def moved(key: str, value: float) -> float:
        step = value - of[key].start
        there = origin[key] + step
        return there if of[key].lower <= there <= of[key].upper else origin[key] - step

    return [{key: moved(key, value) for key, value in place.items()} for place in places]
