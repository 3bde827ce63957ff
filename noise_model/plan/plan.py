"""A whole plan: the search over designs, the paper's rules, the path and what helps where it is blind."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import apply_setup_effects
from noise_model.plan.design import SensorDesign, design_of, filter_of, passes_laser
from noise_model.plan.noise import Surroundings
from noise_model.plan.path import PathNoise, noise_along, nominal_path, recorded_path, search_path
from noise_model.plan.remedies import Cure, find_cures
from noise_model.plan.rules import DesignRules, try_rules
from noise_model.plan.search import DesignCandidate, SearchSpace, judge, pareto, refine, search
from noise_model.setup import Setup

Range = tuple[float, float]
Progress = Callable[[str, int, int], None]
"""Callback with the activity, the number done, and its total."""

SYMMETRIC_JOINTS = ("v_groove", "u_groove", "butt", "fillet", "edge")
"""Joints that are symmetric."""

TILT_STEP_DEG, AZIMUTH_STEP_DEG, PREVIEW_STEP_MM, STAND_OFF_STEP_MM = 10.0, 30.0, 15.0, 75.0
MAP_STEPS_DEG = (5.0, 22.5)
"""Steps of a search, and of the map of the noise, over tilt and azimuth."""

LEFT_OUT = ("interreflection",)
"""Effects that a plan goes without: bounced light moves the seam's sigma by 0.1 % and less.

It takes a second a pose, where a plan looks at thousands and all else takes 5 ms.
"""


@dataclass(frozen=True)
class PlanOptions:
    """Choices of a plan, low and high; None for what fits the setup.

    A torch of `torch_radius_mm`, 0 for none, must not stand in the camera's way. `azimuth_deg` is one side
    for a joint with equal sides, otherwise all around. `limit_mm`: a station whose seam has a larger sigma is
    blind; half of `[tolerance] seam_mm` if not given, so that 2 sigma are borne.
    """

    tilt_deg: Range = (10.0, 60.0)
    azimuth_deg: Range | None = None
    preview_mm: Range = (20.0, 50.0)
    stand_off_mm: Range = (100.0, 250.0)
    filters_nm: tuple[float, ...] = (5.0, 10.0, 20.0)
    max_exposure_s: float | None = None
    lean_deg: float = 10.0
    torch_radius_mm: float = 12.5
    limit_mm: float | None = None
    around: Surroundings = field(default_factory=Surroundings)

    def __post_init__(self) -> None:
        for name in ("tilt_deg", "azimuth_deg", "preview_mm", "stand_off_mm"):
            limits = getattr(self, name)
            if limits is not None and not -math.inf < limits[0] <= limits[1] < math.inf:
                given = f"{name} {limits[0]:g} to {limits[1]:g}"
                raise ValueError(f"{given}: must be finite, and the first not the larger")
        if not (self.tilt_deg[0] >= 0.0 and self.tilt_deg[1] < 85.0):
            raise ValueError("tilt_deg: must lie between 0 and below 85")
        if not (self.preview_mm[0] > 0.0 and self.stand_off_mm[0] > 0.0):
            raise ValueError("preview_mm, stand_off_mm: must be > 0")
        if not self.filters_nm or not all(0.0 < fwhm < math.inf for fwhm in self.filters_nm):
            raise ValueError("filters_nm: must be > 0 and finite, and one at least")
        if not 0.0 <= self.lean_deg <= 45.0:
            raise ValueError(f"lean_deg {self.lean_deg:g}: must be 0 to 45")
        if not 0.0 <= self.torch_radius_mm < math.inf:
            raise ValueError(f"torch_radius_mm {self.torch_radius_mm:g}: must be >= 0 and finite")
        for name in ("max_exposure_s", "limit_mm"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"{name} {value:g}: must be > 0 and finite")


@dataclass(frozen=True, eq=False)
class NoiseMap:
    """The user's design at other tilts (t,) and azimuths (a,), deg; `candidates` (t a,), azimuths first."""

    tilts_deg: tuple[float, ...]
    azimuths_deg: tuple[float, ...]
    candidates: tuple[DesignCandidate, ...]

    def grid(self, name: str) -> Float64:
        """Return one of the numbers of all candidates (t, a)."""
        values = np.array([getattr(c, name) for c in self.candidates])
        return values.reshape(len(self.tilts_deg), len(self.azimuths_deg))


@dataclass(frozen=True, eq=False)
class Plan:
    """All that a plan says. `own` is the user's design as it is, `judged` every design of the search.

    `front` are those that none beats, see `search.pareto`; `cures` is empty where no station is blind.
    `left_out` are those of the setup's effects that did not act.
    """

    setup: Setup
    own: DesignCandidate
    judged: tuple[DesignCandidate, ...]
    front: tuple[DesignCandidate, ...]
    noise_map: NoiseMap
    rules: DesignRules
    along: PathNoise
    cures: tuple[Cure, ...]
    limit_mm: float
    left_out: tuple[str, ...]


def make_plan(
    setup: Setup,
    options: PlanOptions,
    recorded_poses: Sequence[Float64] | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan a sensor for a setup's material, joint and path.

    Designs are compared over one pitch of a corrugation, else at one pose; the path is that of the recorded
    poses T_base_tool if given, else the nominal one. The setup's effects act, on the light of the stripe's
    own pixels: what spreads over the image is taken from them; `LEFT_OUT` do not. Raises ValueError for a
    joint without a seam point, a setup whose sensor sees no stripe on a plate and filters behind which there
    is none.
    """
    setup.require("a plan", "arc", "filter", "material")
    if setup.joint.type == "flat":
        raise ValueError("[joint] type = 'flat': has no seam point to plan for")
    setup = apply_setup_effects(setup)
    left_out = tuple(name for name in setup.effects if name in LEFT_OUT)
    setup = replace(setup, effects={name: v for name, v in setup.effects.items() if name not in LEFT_OUT})
    _check_filters(setup, options.filters_nm)
    tell = progress or (lambda _stage, _done, _total: None)
    own, around = design_of(setup), options.around
    space, poses = search_space(setup, options), search_path(setup).T_base_tool
    [as_is] = judge(setup, own, poses, around)
    judged = search(setup, space, poses, around, lambda n, total: tell("designs", n, total))
    coarse = pareto(judged)
    fine = []
    for n, candidate in enumerate(coarse):
        fine.append(refine(setup, candidate, space, poses, around))
        tell("refinement", n + 1, len(coarse))
    noise_map = _noise_map(setup, space, _azimuths(setup, options), poses, around, tell)
    rules = try_rules(setup, poses, around, own.exposure_s)
    path = nominal_path(setup) if recorded_poses is None else recorded_path(setup, recorded_poses)
    stations = len(path.station_mm)
    along = noise_along(setup, path, around, lambda n: tell("path", n, stations))
    limit_mm = options.limit_mm if options.limit_mm is not None else 0.5 * setup.tolerance.seam_mm
    cures = find_cures(
        setup,
        along,
        limit_mm,
        around,
        options.lean_deg,
        _elsewhere(own, space),
        lambda n, total: tell("blind stretches", n, total),
    )
    return Plan(
        setup=setup,
        own=as_is,
        judged=tuple(judged),
        front=tuple(pareto([*coarse, *fine])),
        noise_map=noise_map,
        rules=rules,
        along=along,
        cures=tuple(cures),
        limit_mm=limit_mm,
        left_out=left_out,
    )


def _check_filters(setup: Setup, filters_nm: Sequence[float]) -> None:
    laser = f"the laser's {setup.laser.wavelength_nm:g} nm"
    if not passes_laser(setup, setup.stated_filter.fwhm_nm):
        raise ValueError(f"[filter]: does not pass {laser}; correct its centre or width")
    for fwhm in (setup.stated_filter.fwhm_nm, *filters_nm):
        if not filter_of(setup, fwhm).edges_nm()[0] > 0.0:
            wide = f"a filter {fwhm:g} nm wide about {setup.stated_filter.center_nm:g} nm"
            raise ValueError(f"{wide} reaches down to 0 nm; take a narrower one, [filter] or --filter-nm")
    if not any(passes_laser(setup, fwhm) for fwhm in filters_nm):
        tried = ", ".join(f"{fwhm:g}" for fwhm in filters_nm)
        raise ValueError(f"no filter {tried} nm wide passes {laser}; name a wider one with --filter-nm")


def search_space(setup: Setup, options: PlanOptions) -> SearchSpace:
    """Return the designs to try."""
    azimuths = _azimuths(setup, options)
    turned = _steps(azimuths, AZIMUTH_STEP_DEG)
    # The longest exposure that is tried, over the user's, where none is given.
    return SearchSpace(
        tilts_deg=_steps(options.tilt_deg, TILT_STEP_DEG),
        # All around, -180 is 180 once more.
        azimuths_deg=turned[1:] if azimuths[1] - azimuths[0] == 360.0 else turned,
        previews_mm=_steps(options.preview_mm, PREVIEW_STEP_MM),
        stand_offs_mm=_steps(options.stand_off_mm, STAND_OFF_STEP_MM),
        filters_nm=tuple(sorted(set(options.filters_nm))),
        max_exposure_s=options.max_exposure_s or 2.0 * setup.camera.exposure_s,
        torch_radius_mm=options.torch_radius_mm,
    )


def _noise_map(
    setup: Setup, space: SearchSpace, around_deg: Range, poses: Float64, around: Surroundings, tell: Progress
) -> NoiseMap:
    own = design_of(setup)
    tilts = _steps((min(space.tilts_deg), max(space.tilts_deg)), MAP_STEPS_DEG[0])
    azimuths = _steps(around_deg, MAP_STEPS_DEG[1])
    candidates = []
    for n, tilt in enumerate(tilts):
        for azimuth in azimuths:
            design = replace(own, tilt_deg=tilt, azimuth_deg=azimuth)
            candidates += judge(setup, design, poses, around, None, space.max_exposure_s)
        tell("map", n + 1, len(tilts))
    return NoiseMap(tilts, azimuths, tuple(candidates))


def _elsewhere(own: SensorDesign, space: SearchSpace) -> list[SensorDesign]:
    """Return the user's own design at the other tilts and azimuths of a space."""
    here = replace(space, previews_mm=(own.preview_mm,), stand_offs_mm=(own.stand_off_mm,))
    return here.poses(own)


def _azimuths(setup: Setup, options: PlanOptions) -> Range:
    if options.azimuth_deg is not None:
        return options.azimuth_deg
    is_symmetric = setup.joint.type in SYMMETRIC_JOINTS and setup.material.lobe.anisotropy == 0.0
    return (0.0, 180.0) if is_symmetric else (-180.0, 180.0)


def _steps(limits: Range, step: float) -> tuple[float, ...]:
    low, high = limits
    count = max(1, round((high - low) / step)) + 1 if high > low else 1
    return tuple(float(v) for v in np.linspace(low, high, count))
