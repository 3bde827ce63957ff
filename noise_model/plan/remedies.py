"""Remedies where the sensor is blind: another exposure, the torch tilted, the camera elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.plan.design import SensorDesign, design_of
from noise_model.plan.noise import Surroundings
from noise_model.plan.path import PathNoise, blind_stretches, leaned
from noise_model.plan.search import DesignCandidate, Progress, judge
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert


@dataclass(frozen=True)
class Cure:
    """Remedies of a blind stretch of stations `first` to `last`, inclusive: three cures, each by itself.

    `exposed` is the user's design with an exposure so short that nothing saturates. `leaned` leans the torch
    about its tip by `lean_deg` (travel, work), its upper end ahead and to the left positive: the smallest
    lean that brings the seam's sigma below the limit, else the best. `moved` puts the camera where the sigma
    is least of the poses tried. Sigmas are the worst of the stretch's ends, middle and worst station,
    infinite where the seam stays unknown.
    """

    first: int
    last: int
    exposed: DesignCandidate
    lean_deg: tuple[float, float]
    leaned: DesignCandidate
    moved: DesignCandidate


def find_cure(
    setup: Setup,
    along: PathNoise,
    stretch: tuple[int, int],
    limit_mm: float,
    around: Surroundings,
    lean_deg: float,
    designs: Sequence[SensorDesign],
) -> Cure:
    """Try what might help a stretch: leans up to `lean_deg`, and other `designs`."""
    own = design_of(setup)
    poses = _poses(along, stretch)

    def worst(
        design: SensorDesign, lean: tuple[float, float], max_exposure_s: float | None
    ) -> DesignCandidate:
        turned = np.array([leaned(T_base_tool, *lean) for T_base_tool in poses])
        return judge(setup, design, turned, around, None, max_exposure_s)[0]

    upright = (0.0, 0.0)
    # Number of tilts tried to either side, in travel and in work angle.
    angles = np.linspace(-lean_deg, lean_deg, 2 * 2 + 1)
    leans = sorted(((float(t), float(w)) for t in angles for w in angles), key=lambda lean: math.hypot(*lean))
    best_lean, best = upright, worst(own, upright, None)
    for lean in leans[1:] if lean_deg > 0.0 else []:
        judged = worst(own, lean, None)
        if judged.sigma_mm < best.sigma_mm:
            best_lean, best = lean, judged
        if best.sigma_mm <= limit_mm:
            break
    moved = [worst(design, upright, None) for design in designs]
    return Cure(
        *stretch,
        exposed=worst(own, upright, own.exposure_s),
        lean_deg=best_lean,
        leaned=best,
        moved=min(moved, key=lambda c: c.sigma_mm, default=best),
    )


def find_cures(
    setup: Setup,
    along: PathNoise,
    limit_mm: float,
    around: Surroundings,
    lean_deg: float,
    designs: Sequence[SensorDesign],
    progress: Progress | None = None,
) -> list[Cure]:
    """Return a cure for every stretch where the seam's sigma is above a limit; see `find_cure`.

    Stretches of a straight seam in which the tool stands over a corrugation in the same way share one.
    """
    stretches = blind_stretches(along, limit_mm)
    known: dict[tuple[float, ...], Cure] = {}
    cures = []
    for n, (first, last) in enumerate(stretches):
        pose_key = _cure_key(setup, along, first, last)
        if pose_key not in known:
            known[pose_key] = find_cure(setup, along, (first, last), limit_mm, around, lean_deg, designs)
        cures.append(replace(known[pose_key], first=first, last=last))
        if progress is not None:
            progress(n + 1, len(stretches))
    return cures


def _cure_key(setup: Setup, along: PathNoise, first: int, last: int) -> tuple[float, ...]:
    """Return the key of stretches that share a cure.

    It is the tool's poses at the stations tried, relative to the joint, places along the seam by the pitch.
    Bends have nothing in common: where the tool stands in the same way, the stripe ahead of it may lie on
    another leg.
    """
    if len(setup.joint.seam_in_base_mm) > 2:
        return (first, last)
    pitch = float(setup.joint.dimensions["pitch_mm"]) if setup.joint.type == "corrugation" else 1e-3
    place: list[float] = []
    for T_base_tool in _poses(along, (first, last)):
        T_joint_tool = invert(seam_frame(setup.joint, T_base_tool[:3, 3])) @ T_base_tool
        # A place a hair below a pitch is one a hair above it.
        T_joint_tool[0, 3] = (T_joint_tool[0, 3] + 2e-4) % pitch
        place += [float(value) for value in T_joint_tool[:3].ravel().round(3) + 0.0]
    return (last - first, *place)


def _poses(along: PathNoise, stretch: tuple[int, int]) -> Float64:
    first, last = stretch
    sigma = along.column("sigma_mm")[first : last + 1]
    worst = first + int(np.argmax(np.where(np.isfinite(sigma), sigma, math.inf)))
    chosen = sorted({first, (first + last) // 2, worst, last})
    return along.path.T_base_tool[chosen]
