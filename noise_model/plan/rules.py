"""The paper's two rules, tried on a setup: tilt the sensor little, and stand out of the plane of incidence.

Both are about the arc's light on the stripe. Under a sheet that keeps its direction a small tilt and an
azimuth aside also cost triangulation, sin(tilt) cos(azimuth) for an upright one, so each rule has two
outcomes: one for the light on the stripe, one for the seam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.plan.design import SensorDesign, design_of
from noise_model.plan.noise import Surroundings
from noise_model.plan.search import DesignCandidate, judge
from noise_model.setup import Setup

TILTS_DEG = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
AZIMUTHS_DEG = (0.0, 30.0, 60.0, 90.0, 120.0, 150.0, 180.0)

ASIDE_DEG = 60.0
"""Angle out of the plane of incidence at which rule two is tried: at 90 deg an upright sheet shows no height.
"""

MATTERS = 1.1
"""A ratio nearer to 1 than this is no difference."""


class RuleOutcome(Enum):
    """Outcome of a rule; the value is its wording."""

    HOLDS = "holds"
    FAILS = "does not hold"
    INDIFFERENT = "makes no difference"
    UNKNOWN = "cannot be told"


@dataclass(frozen=True)
class DesignRule:
    """A rule as tried: the varied angle of each of `tried` (deg), and the outcomes for light and seam.

    `light_ratio` is the arc's light over the stripe's where the rule is broken, at `broken_deg`, over that
    where it is kept, at `kept_deg`; `seam_ratio` the same of the seam's sigma. The angles compared are those
    that show the whole path: what hides a bright flank from the camera keeps no light off it.
    """

    angles_deg: tuple[float, ...]
    tried: tuple[DesignCandidate, ...]
    broken_deg: float
    kept_deg: float
    light_ratio: float
    seam_ratio: float

    @property
    def light(self) -> RuleOutcome:
        """Outcome for the arc's light over the stripe's when the rule is kept."""
        return _outcome(self.light_ratio)

    @property
    def seam(self) -> RuleOutcome:
        """Outcome for the seam's sigma when the rule is kept."""
        return _outcome(self.seam_ratio)

    @property
    def best_deg(self) -> float:
        """The angle of the smallest sigma of the seam; NaN where none shows it."""
        sigmas = np.array([c.sigma_mm for c in self.tried])
        return self.angles_deg[int(np.argmin(sigmas))] if np.isfinite(sigmas).any() else math.nan


@dataclass(frozen=True)
class DesignRules:
    """The rules on a user's own material and joint, `own` the user's design as it is.

    `tilt` with the laser's sheet as it stands; `head` with the whole head tilted, so that the sheet leans and
    the triangulation angle stays; `azimuth` at the user's tilt.
    """

    own: DesignCandidate
    tilt: DesignRule
    head: DesignRule
    azimuth: DesignRule


def try_rules(setup: Setup, poses: Float64, around: Surroundings, max_exposure_s: float) -> DesignRules:
    """Try both rules at poses T_base_tool (n, 4, 4)."""
    own = design_of(setup)

    def tried(designs: Sequence[SensorDesign]) -> tuple[DesignCandidate, ...]:
        return tuple(judge(setup, d, poses, around, None, max_exposure_s)[0] for d in designs)

    tilted = tried([replace(own, tilt_deg=t) for t in TILTS_DEG])
    heads = [(t, design) for t in TILTS_DEG if (design := head_tilted(own, t)) is not None]
    turned = tried([replace(own, azimuth_deg=a) for a in AZIMUTHS_DEG])
    ahead = abs(own.azimuth_deg) <= 90.0
    head = tried([design for _, design in heads])
    return DesignRules(
        own=judge(setup, own, poses, around)[0],
        tilt=_rule(TILTS_DEG, tilted, (TILTS_DEG[-1], TILTS_DEG[0])),
        head=_rule([t for t, _ in heads], head, (TILTS_DEG[-1], TILTS_DEG[0])),
        azimuth=_rule(AZIMUTHS_DEG, turned, (0.0, ASIDE_DEG) if ahead else (180.0, 180.0 - ASIDE_DEG)),
    )


def head_tilted(own: SensorDesign, tilt_deg: float) -> SensorDesign | None:
    """Return a design at another tilt whose sheet leans so that the triangulation angle stays.

    With forward f = sin(tilt) cos(azimuth) and up u = cos(tilt) the angle's sine is f cos(lean) - u sin(lean)
    = r sin(phi - lean), r = sqrt(f^2 + u^2), phi = atan2(f, u). None where the azimuth leaves no such lean.
    """

    def across(tilt: float) -> tuple[float, float]:
        forward = math.sin(math.radians(tilt)) * math.cos(math.radians(own.azimuth_deg))
        up = math.cos(math.radians(tilt))
        return math.hypot(forward, up), math.atan2(forward, up)

    r, phi = across(own.tilt_deg)
    sine = r * math.sin(phi - math.radians(own.lean_deg))
    r, phi = across(tilt_deg)
    if abs(sine) >= r:
        return None
    lean_deg = math.degrees(phi - math.asin(sine / r))
    return replace(own, tilt_deg=tilt_deg, lean_deg=lean_deg) if abs(lean_deg) < 75.0 else None


def _rule(
    angles_deg: Sequence[float], tried: tuple[DesignCandidate, ...], ends: tuple[float, float]
) -> DesignRule:
    """Compare the angles nearest to where the rule is broken and kept, `ends`, that show the seam."""
    seen = [(angle, c) for angle, c in zip(angles_deg, tried, strict=True) if math.isfinite(c.sigma_mm)]
    if not seen:
        return DesignRule(tuple(angles_deg), tried, *[math.nan] * 4)
    (broken_deg, broken), (kept_deg, kept) = (min(seen, key=lambda pair: abs(pair[0] - end)) for end in ends)
    if broken_deg == kept_deg:
        return DesignRule(tuple(angles_deg), tried, *[math.nan] * 4)
    return DesignRule(
        tuple(angles_deg),
        tried,
        broken_deg,
        kept_deg,
        _ratio(broken.arc_over_stripe, kept.arc_over_stripe),
        broken.sigma_mm / kept.sigma_mm,
    )


def _ratio(broken: float, kept: float) -> float:
    # Where both are dark of arc light there is nothing to avoid.
    return 1.0 if broken == kept == 0.0 else broken / kept if kept > 0.0 else math.inf


def _outcome(ratio: float) -> RuleOutcome:
    if math.isnan(ratio):
        return RuleOutcome.UNKNOWN
    if ratio > MATTERS:
        return RuleOutcome.HOLDS
    return RuleOutcome.FAILS if ratio < 1.0 / MATTERS else RuleOutcome.INDIFFERENT
