"""Misfit: another surface next to a seam, such as a bead's or a rounded edge's, that no face explains.

Such points lie off their face to one side. By noise, as neighbours share it, the sum of k distances in sigmas
has the variance k. Half the sum's square over k, less what chance makes among as many sums, is the evidence
that the points are another surface's. An edge next to it is not seen: it may lie as far to either side as
that surface reaches.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from tracker.joint.measured import section_at
from tracker.joint.section_fit import SIGMA_FLOOR_PX
from tracker.profile import Section, in_scan_order
from tracker.state import BESIDE_PX, DY_MM, DZ_MM, MISFIT_PX, SIGMA_PX, Y_MM, Z_MM

FLAT_MM = 0.02
"""Distance from a face that is the face's own: no plate is flatter."""

MAX_SIGMAS = 3.0
"""A point counts by no more: one or two lines of spatter, or of light of two faces, are no surface."""

NEAR_MM = 2.0
"""Farther from a seam or an edge a surface leaves it as it is."""

EDGE_MM = 1e-6
"""So near to an edge either face is taken."""


class SeamEdge(NamedTuple):
    """Place y, mm, of an edge, and how much seam y and z and gap move with it.

    One that is not upright lies between faces that show it even where another surface covers it.
    """

    y_mm: float
    by_y: float = 1.0
    by_z: float = 0.0
    by_gap: float = 0.0
    is_upright: bool = True


class Misfit(NamedTuple):
    """Reach, mm, of another surface than the section's from a place, and its evidence, nats."""

    reach_mm: float
    nats: float


@kernel(allocates=True)
def find_misfit(section: Section, corners_mm: Float64, place_mm: float) -> Misfit:
    """Return the misfit of a section to a shape of corners (k, 2) next to a place.

    Where lines hold light of both sides a point may lie on the other side's face carried on.
    """
    lines, column_mm = in_scan_order(section.points), section.column_mm
    y_mm, n, start, n_near = lines[Y_MM], lines.shape[1], 0, 1
    height_mm, slope = section_at(corners_mm, y_mm)
    side_mm, side_slope = section_at(corners_mm, np.array([place_mm - EDGE_MM, place_mm + EDGE_MM]))
    off = np.empty(n)
    for i in range(n):
        away_mm = y_mm[i] - place_mm
        start += away_mm < 0.0
        n_near += abs(away_mm) < NEAR_MM
        off_mm = lines[Z_MM, i] - height_mm[i]
        if abs(away_mm) < section.mixed_mm:
            for k in range(2):
                carried_mm = lines[Z_MM, i] - side_mm[k] - side_slope[k] * away_mm
                off_mm = carried_mm if abs(carried_mm) < abs(off_mm) else off_mm
        px = max(lines[SIGMA_PX, i], lines[BESIDE_PX, i]) ** 2 + lines[MISFIT_PX, i] ** 2 + SIGMA_FLOOR_PX**2
        own_mm = abs(lines[DZ_MM, i] - slope[i] * lines[DY_MM, i]) * math.sqrt(px)
        off[i] = math.copysign(min(max(abs(off_mm) - FLAT_MM, 0.0) / own_mm, MAX_SIGMAS), off_mm)
    best = Misfit(0.0, -math.log(n_near))
    for towards in (-1, 1):
        i, total, count = start if towards > 0 else start - 1, 0.0, 0
        while 0 <= i < n and abs(y_mm[i] - place_mm) < NEAR_MM:
            # A line that crosses the edge holds light of either side.
            if abs(y_mm[i] - place_mm) > column_mm:
                total, count = total + off[i], count + 1
                nats = 0.5 * total * total / count - math.log(n_near)
                if nats > best.nats:
                    best = Misfit(abs(y_mm[i] - place_mm), nats)
            i += towards
    return best
