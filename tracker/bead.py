"""A weld's bead in a profile across it: toes, width, excess, undercut, legs, throat, each with its sigma.

The profile is a Gaussian process. Outside the toes the plates are lines with texture. Between them the bead
is a curve that starts and ends on the plates with any slope: a Wiener process integrated once, as of a cubic
smoothing spline (Wahba 1978, J. R. Stat. Soc. B 40, 364), conditioned on its end. A toe is where the plate
and the bead's flank would meet; how it is rounded is a term of its own. So the evidence of a pair of toes is
a closed form, and their posterior needs no threshold of height or slope. Noise, texture, curvature and
rounding are those of the largest evidence.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import minimize

from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly

MAX_POINTS, COARSE_POINTS, MIN_POINTS = 240, 120, 150
"""A profile is brought down to so many points, as the evidence takes their cube; for a search to the second.

One of fewer points than the last is not measured.
"""

MIN_EACH = 3
"""Neighbours whose median stands for them, at least: one that is a false echo is left out."""

NOISE_PROFILES = 4
"""Profiles whose noise stands for that of all."""

TOE_PLACES, FINE_PLACES = 16, 25
"""Places at which a toe is sought over the profile, and about the best of them."""

SLOPE_SIGMA, PLATE_SIGMA_MM, PLATE_SLOPE_SIGMA = 3.0, 100.0, 3.0
"""1 sigma of what nothing is known of: the bead's slope at a toe, and the plates' heights and slopes."""

NOISE_START = np.log([0.01, 0.03, 1.0, 0.05, 0.3])
NOISE_BOUNDS = np.log([[1e-3, 1.0], [1e-3, 1.0], [0.1, 20.0], [1e-5, 100.0], [0.03, 3.0]])
"""Natural logarithms of where the search of `Noise` starts, and of its bounds."""

MIN_EVIDENCE = math.log(1000.0)
"""A bead's evidence over that of plates alone, nats: one false bead in a thousand profiles."""

TEXTURE_RATIOS = (0.7, 1.0, 1.5)
"""Ratios of a profile's texture to that of the others: the likeliest counts."""

FILLET_DEG = 30.0
"""Plates that meet at more than this are a fillet's: a butt's are bent by less."""

DRAWS = 200
"""Draws of the posterior, by which a sigma is good to 5 %."""


MEASURES = {
    "toe_right_mm": "right toe",
    "toe_left_mm": "left toe",
    "width_mm": "width, toe to toe",
    "excess_mm": "excess metal over the line of the toes",
    "undercut_right_mm": "undercut, right",
    "undercut_left_mm": "undercut, left",
    "misalignment_mm": "misalignment, left plate over right",
    "angle_deg": "angle by which the plates bend",
    "leg_right_mm": "leg, right",
    "leg_left_mm": "leg, left",
    "throat_mm": "throat, root to face",
}
"""Each measure by its name, whose unit stands last, in the terms of ISO 5817 where it has one."""


class Noise(NamedTuple):
    """White noise, texture and its length, mm; the bead's squared curvature, mm^-1; the toes' radius, mm."""

    white_mm: float
    texture_mm: float
    texture_length_mm: float
    curvature: float
    toe_radius_mm: float


class BeadMeasure(NamedTuple):
    """A value and its 1 sigma."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Bead:
    """Measures of a bead by their names, and its face (n, 2), mm; or the `problem` why there are none."""

    problem: str = ""
    measures: dict[str, BeadMeasure] = field(default_factory=dict)
    face_mm: Float64 = field(default_factory=lambda: np.empty((0, 2)))


class _Posterior(NamedTuple):
    """Mean (4 + n,) and covariance of the plates' numbers and of the bead over the chord between its toes."""

    mean: Float64
    covariance: Float64


@dataclass(frozen=True)
class _Profile:
    """Places (n,), rising, and heights (n,), both about `middle_mm` (2,), mm."""

    y_mm: Float64
    z_mm: Float64
    middle_mm: Float64

    def thinned(self, max_points: int, min_each: int = 1) -> "_Profile":
        """Return means of so many neighbours that few enough points are left; of heights their medians."""
        each = max(-(-len(self.y_mm) // max_points), min_each)
        whole = len(self.y_mm) // each * each
        y_mm, z_mm = (values[:whole].reshape(-1, each) for values in (self.y_mm, self.z_mm))
        return _Profile(y_mm.mean(axis=1), np.median(z_mm, axis=1), self.middle_mm)

    def plates(self, toes_mm: Float64) -> Float64:
        """Return the design matrix (n, 4) of the toes' heights, joined by a chord, and the plates' slopes."""
        right, left = toes_mm
        share = np.clip((self.y_mm - right) / (left - right), 0.0, 1.0)
        outside = np.minimum(self.y_mm, right) - right, np.maximum(self.y_mm, left) - left
        return np.column_stack([1.0 - share, share, *outside])

    def roundings(self, toes_mm: Float64, noise: Noise) -> Float64:
        """Return how far the toes are rounded, 1 sigma (n, 2), mm: a slope times half the radius."""
        apart = np.abs(self.y_mm[:, None] - toes_mm) / noise.toe_radius_mm
        return np.asarray(0.5 * SLOPE_SIGMA * noise.toe_radius_mm * np.exp(-apart))

    def texture(self, noise: Noise) -> Float64:
        """Return the covariance (n, n) of texture and noise: an Ornstein-Uhlenbeck process, and white."""
        apart = np.abs(np.subtract.outer(self.y_mm, self.y_mm)) / noise.texture_length_mm
        return np.asarray(noise.texture_mm**2 * np.exp(-apart) + noise.white_mm**2 * np.eye(len(self.y_mm)))

    def bead(self, toes_mm: Float64, noise: Noise) -> Float64:
        """Return the covariance (n, n) of the bead over the chord, which its roundings leave at the toes."""
        length = toes_mm[1] - toes_mm[0]
        s = np.clip(self.y_mm - toes_mm[0], 0.0, length)
        less, more = np.minimum.outer(s, s), np.maximum.outer(s, s)
        slope = SLOPE_SIGMA**2 * s
        free = noise.curvature * less**2 * (3.0 * more - less) / 6.0 + np.outer(slope, s)
        with_end = noise.curvature * s**2 * (3.0 * length - s) / 6.0 + slope * length
        end = noise.curvature * length**3 / 3.0 + SLOPE_SIGMA**2 * length**2
        rounding = self.roundings(toes_mm, noise)
        return np.asarray(free - np.outer(with_end, with_end) / end + rounding @ rounding.T)

    def log_evidence(self, design: Float64, covariance: Float64) -> float:
        """Return the log-likelihood of the heights, but for a constant, plates unknown."""
        total = covariance + (design * _plate_variance(design)) @ design.T
        try:
            factor = cho_factor(total, lower=True, check_finite=False)
        except LinAlgError:
            return -math.inf
        fit = float(self.z_mm @ cho_solve(factor, self.z_mm))
        return -0.5 * fit - float(np.log(np.diag(factor[0])).sum())

    def of_toes(self, toes_mm: Float64, noise: Noise) -> float:
        """Return the evidence of a bead between two toes."""
        return self.log_evidence(self.plates(toes_mm), self.bead(toes_mm, noise) + self.texture(noise))

    def of_plates(self, noise: Noise) -> float:
        """Return the largest evidence of plates without a bead, which meet at some place."""
        texture, ones = self.texture(noise), np.ones_like(self.y_mm)
        return max(
            self.log_evidence(
                np.column_stack([ones, np.minimum(self.y_mm, y), np.maximum(self.y_mm, y)]), texture
            )
            for y in np.linspace(self.y_mm[0], self.y_mm[-1], TOE_PLACES)[1:-1]
        )

    def posterior(self, toes_mm: Float64, noise: Noise) -> _Posterior:
        """Return what the heights say of plates and bead, the toes given."""
        design, bead = self.plates(toes_mm), self.bead(toes_mm, noise)
        variance = _plate_variance(design)
        with_heights = np.vstack([variance[:, None] * design.T, bead])
        prior = np.zeros((len(with_heights),) * 2)
        prior[:4, :4], prior[4:, 4:] = np.diag(variance), bead
        total = bead + self.texture(noise) + (design * variance) @ design.T
        factor = cho_factor(total, lower=True, check_finite=False)
        gain = cho_solve(factor, with_heights.T).T
        return _Posterior(gain @ self.z_mm, prior - gain @ with_heights.T)

    def values(self, toes_mm: Float64, state: Float64) -> dict[str, float]:
        """Return each measure of a bead by its toes, plates and its height over the chord."""
        y_mm, (right_z, left_z, right_slope, left_slope) = self.y_mm, state[:4]
        (right, left), over = toes_mm, state[4:]
        chord = math.atan2(left_z - right_z, left - right)
        is_face = (y_mm > right) & (y_mm < left)
        off, place = over[is_face] * math.cos(chord), y_mm[is_face]
        is_right = place < 0.5 * (right + left)
        amid = 0.5 * (right + left)
        values = {
            "toe_right_mm": right + self.middle_mm[0],
            "toe_left_mm": left + self.middle_mm[0],
            "width_mm": math.hypot(left - right, left_z - right_z),
            "excess_mm": float(off.max(initial=0.0)),
            "undercut_right_mm": float((-off[is_right]).max(initial=0.0)),
            "undercut_left_mm": float((-off[~is_right]).max(initial=0.0)),
            "misalignment_mm": left_z + left_slope * (amid - left) - right_z - right_slope * (amid - right),
            "angle_deg": math.degrees(math.atan(left_slope) - math.atan(right_slope)),
        }
        if abs(values["angle_deg"]) > FILLET_DEG:
            # The plates' lines meet at the root.
            root_y = (right_z - right_slope * right - left_z + left_slope * left) / (left_slope - right_slope)
            root_z = right_z + right_slope * (root_y - right)
            face_z = right_z + (left_z - right_z) * (place - right) / (left - right) + over[is_face]
            for of_butt in ("misalignment_mm", "undercut_right_mm", "undercut_left_mm"):
                del values[of_butt]
            values |= {
                "leg_right_mm": math.hypot(root_y - right, root_z - right_z),
                "leg_left_mm": math.hypot(root_y - left, root_z - left_z),
                "throat_mm": float(np.hypot(place - root_y, face_z - root_z).min(initial=math.inf)),
            }
        return values


def _plate_variance(design: Float64) -> Float64:
    """Return the prior variance of a design's numbers: as many heights as are not slopes, then two slopes."""
    return np.array([PLATE_SIGMA_MM**2] * (design.shape[1] - 2) + [PLATE_SLOPE_SIGMA**2] * 2)


def measure_beads(profiles: Sequence[tuple[Float64, Float64]]) -> Iterator[Bead]:
    """Yield the bead in each of some profiles of one sensor, which share their noise.

    A profile has places (n,) across the weld, rising, and heights (n,), mm; those that are NaN are left out.
    The measures of a bead are those of `MEASURES`. Plates at more than 30 deg, a fillet's, have legs and
    throat in place of undercut and misalignment.
    """
    fitted = [_centred(y_mm, z_mm) for y_mm, z_mm in profiles]
    whole = [profile for profile in fitted if profile is not None]
    noise = _fit_noise([whole[n] for n in evenly(len(whole), NOISE_PROFILES)]) if whole else None
    for profile in fitted:
        yield Bead("too_few_points") if profile is None or noise is None else _measure(profile, noise)


def _centred(y_mm: Float64, z_mm: Float64) -> _Profile | None:
    """Return the known points of a profile, None if they are too few."""
    known = np.isfinite(y_mm) & np.isfinite(z_mm)
    if known.sum() < MIN_POINTS:
        return None
    y_mm, z_mm = y_mm[known], z_mm[known]
    middle_mm = np.array([y_mm.mean(), z_mm.mean()])
    return _Profile(y_mm - middle_mm[0], z_mm - middle_mm[1], middle_mm).thinned(MAX_POINTS, MIN_EACH)


def _coarse_toes(coarse: _Profile, noise: Noise) -> tuple[Float64, Float64]:
    """Return the most probable toes (2,), and their 1 sigma (2,) about these by their posterior.

    They are sought among pairs of places, then among all points on either side in turn.
    """
    y_mm = coarse.y_mm[2:-2]
    places = y_mm[:: -(-len(y_mm) // TOE_PLACES)]
    pairs = [np.array([a, b]) for n, a in enumerate(places) for b in places[n + 1 :]]
    toes_mm = max(pairs, key=lambda pair: coarse.of_toes(pair, noise))
    sigma_mm = np.zeros(2)
    for side in (0, 1, 0, 1):
        on_side = y_mm[y_mm < toes_mm[1]] if side == 0 else y_mm[y_mm > toes_mm[0]]
        weight = _posterior_weight(coarse, noise, toes_mm, side, on_side)
        toes_mm = np.where(np.arange(2) == side, on_side[weight.argmax()], toes_mm)
        sigma_mm[side] = math.sqrt(weight @ (on_side - toes_mm[side]) ** 2)
    return toes_mm, sigma_mm


def _posterior_weight(
    profile: _Profile, noise: Noise, toes_mm: Float64, side: int, places_mm: Float64
) -> Float64:
    """Return the probability (n,) of places of one toe, the other given."""
    pairs = [np.where(np.arange(2) == side, place, toes_mm) for place in places_mm]
    evidence = np.array([profile.of_toes(pair, noise) for pair in pairs])
    weight = np.exp(evidence - evidence.max())
    return np.asarray(weight / weight.sum())


def _fit_noise(profiles: Sequence[_Profile]) -> Noise:
    """Return the noise, texture and curvature of the largest evidence of all of some profiles."""
    noise = Noise(*np.exp(NOISE_START))
    simplex = NOISE_START + np.vstack([np.zeros(5), np.eye(5)])
    for _ in range(2):
        toes_mm = [_coarse_toes(profile.thinned(COARSE_POINTS), noise)[0] for profile in profiles]
        fitted = minimize(
            lambda ln, toes_mm=toes_mm: (
                -sum(
                    profile.of_toes(toes, Noise(*np.exp(ln)))
                    for profile, toes in zip(profiles, toes_mm, strict=True)
                )
            ),
            NOISE_START,
            method="Nelder-Mead",
            bounds=NOISE_BOUNDS,
            options={"xatol": 0.05, "fatol": 0.05, "maxfev": 200, "initial_simplex": simplex},
        )
        noise = Noise(*np.exp(fitted.x))
    return noise


def _fine_toes(profile: _Profile, noise: Noise, near_mm: Float64) -> tuple[Float64, Float64]:
    """Return the toes' places (2,) between points, near some places, and their 1 sigma (2,)."""
    toes_mm, y_mm = near_mm.copy(), profile.y_mm
    margin_mm = y_mm[2] - y_mm[0]
    sigma_mm = np.full(2, margin_mm)
    for side in (0, 1, 0, 1, 0, 1):
        low, high = ((y_mm[2], toes_mm[1] - margin_mm), (toes_mm[0] + margin_mm, y_mm[-3]))[side]
        reach_mm = 4.0 * sigma_mm[side]
        grid = np.linspace(
            max(low, toes_mm[side] - reach_mm), min(high, toes_mm[side] + reach_mm), FINE_PLACES
        )
        weight = _posterior_weight(profile, noise, toes_mm, side, grid)
        toes_mm[side] = weight @ grid
        # The posterior varies between two places.
        sigma_mm[side] = math.hypot(
            math.sqrt(weight @ (grid - toes_mm[side]) ** 2), (grid[1] - grid[0]) / math.sqrt(12.0)
        )
    return toes_mm, sigma_mm


def _measure(profile: _Profile, shared: Noise) -> Bead:
    coarse = profile.thinned(COARSE_POINTS)
    noises = [shared._replace(texture_mm=ratio * shared.texture_mm) for ratio in TEXTURE_RATIOS]
    searched = [(noise, *_coarse_toes(coarse, noise)) for noise in noises]
    noise, near_mm, far_mm = max(searched, key=lambda search: coarse.of_toes(search[1], search[0]))
    toes_mm, sigma_mm = _fine_toes(profile, noise, near_mm)
    # Another place that is nearly as probable counts as well.
    spread_mm = np.maximum(sigma_mm, far_mm)
    if profile.of_toes(toes_mm, noise) - profile.of_plates(noise) < MIN_EVIDENCE:
        return Bead("no_bead")
    best = profile.posterior(toes_mm, noise)
    values = profile.values(toes_mm, best.mean)
    # Beyond the toes the bead is 0 for certain: the covariance has no Cholesky factor.
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(*best, DRAWS, check_valid="ignore", method="eigh")
    drawn = [profile.values(toes_mm, draw) for draw in draws]
    moved = [toes_mm + sign * sigma_mm * (np.arange(2) == side) for side in (0, 1) for sign in (1.0, -1.0)]
    by_toes = [profile.values(toes, profile.posterior(toes, noise).mean) for toes in moved]
    measures = {}
    for name, value in values.items():
        a, b, c, d = (other.get(name, math.nan) for other in by_toes)
        by_toe = 0.5 * np.array([a - b, c - d]) * spread_mm / sigma_mm
        variance = np.var([draw.get(name, math.nan) for draw in drawn]) + by_toe @ by_toe
        measures[name] = BeadMeasure(value, math.sqrt(variance))
    face_mm = np.column_stack([profile.y_mm, profile.plates(toes_mm) @ best.mean[:4] + best.mean[4:]])
    return Bead("", measures, face_mm + profile.middle_mm)
