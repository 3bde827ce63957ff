"""The stated type of joint against what the profile shows: straight pieces with change points, penalised.

The profile is cut into straight pieces so that the sum over them of chi2 + 3 ln n is least: each piece costs
its two parameters and its change point (Schwarz 1978, Annals of Statistics 6, 461; the optimal partition by
Jackson et al. 2005, IEEE Signal Processing Letters 12, 105). What the pieces look like is a family of joints.
The stated type is doubted where that is another one, and explains the profile decidedly better than the
stated type's own fit does.
"""

from __future__ import annotations

import itertools
import math
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.surface.joint import Joint
from tracker.joint.measured import MeasuredJoint, section_at
from tracker.joint.plate_lines import BLURRED_LINES
from tracker.profile import Section
from tracker.state import DZ_MM, SIGMA_PX, Y_MM, Z_MM

GROUPS = 120
"""About so many groups of neighbouring points, each its median, are cut into pieces."""

MIN_OPENING_MM, MIN_STEP_MM = 0.4, 0.3
"""Least depth of an opening, and least height of a step."""

MIN_CORNER_DEG, MIN_BEVEL_RISE_MM = 12.0, 0.8
"""Plates that are turned by more form a corner; a piece that rises by more between plates is a bevel."""

MIN_BEVEL_GROUPS = 3
"""Fewer groups than this are no bevel: two may lie on either side of an upright edge."""

CORNER_OFF_MM = 1.5
"""Largest distance of the corner of two plates' lines from the ends of their pieces, which are as long."""

STATED_PARAMETERS = 10
"""As many as the shape has that has most."""

FARTHEST = 25.0
"""Cap of one group's share of the stated type's chi2."""


class JointFamily(Enum):
    """Features of a profile's pieces."""

    FLAT = "a plate"
    INSIDE_CORNER = "two plates that rise from a corner"
    OUTSIDE_CORNER = "two plates that fall from a corner"
    STEP = "two sheets, one higher"
    SLOT = "two plates and an upright gap"
    GROOVE = "two plates and a bevelled groove"


FAMILIES = {
    "v_groove": JointFamily.GROOVE,
    "half_v": JointFamily.GROOVE,
    "u_groove": JointFamily.GROOVE,
    "lap": JointFamily.STEP,
    "corrugation": JointFamily.STEP,
    "butt": JointFamily.SLOT,
    "outside_corner": JointFamily.OUTSIDE_CORNER,
}


def family_of(joint: Joint) -> JointFamily | None:
    """Return the family of a stated joint; None for an edge and a free one: no plates tell it."""
    if joint.type == "fillet":
        inside = joint.dimensions["included_angle_deg"] < 180.0
        return JointFamily.INSIDE_CORNER if inside else JointFamily.OUTSIDE_CORNER
    return FAMILIES.get(joint.type)


def shows_another(section: Section, joint: Joint, measured: MeasuredJoint | None) -> bool:
    """Return True if a section decidedly shows another family of joints than the stated one's.

    `measured` is the stated type's fit, None where there is none.
    """
    family = family_of(joint)
    if family is None:
        return False
    groups = groups_of(section.points)
    shown, cost = family_shown(groups)
    if shown in (None, family):
        return False
    if family is JointFamily.SLOT and shown is JointFamily.FLAT:
        # A gap may show nothing but missing points, and a narrow one not even those.
        return measured is None and joint.dimensions["gap_mm"] >= BLURRED_LINES * section.column_mm
    # Another family must be better by this much of chi2: e^15 to 1.
    return measured is None or cost + 30.0 < stated_cost(groups, measured.corners_mm)


def shown_family(points: Float64) -> JointFamily | None:
    """Return the family that points' straight pieces look like, None for none known."""
    return family_shown(groups_of(points))[0]


class Groups(NamedTuple):
    """The median points (n,) of neighbouring points: y and z, mm, and the sigma of z."""

    y_mm: Float64
    z_mm: Float64
    sigma_mm: Float64


def groups_of(points: Float64) -> Groups:
    """Return the groups of points, y rising."""
    size = max(1, -(-points.shape[1] // GROUPS))
    n = points.shape[1] // size
    order = np.argsort(points[Z_MM, : n * size].reshape(n, size), axis=1, kind="stable")
    middle = points[:, order[:, (size - 1) // 2] + size * np.arange(n)]
    own_mm = np.abs(middle[DZ_MM]) * middle[SIGMA_PX]
    # Distance of a point from a piece beyond its noise: types differ by more than parts do from drawings.
    return Groups(middle[Y_MM].copy(), middle[Z_MM].copy(), np.hypot(own_mm, 0.05))


def stated_cost(groups: Groups, corners_mm: Float64) -> float:
    """Return the stated type's own cost: chi2 about its fitted section (m, 2) and its parameters' penalty."""
    # Beyond its ends a section goes on level.
    height_mm, _ = section_at(corners_mm, np.clip(groups.y_mm, corners_mm[0, 0], corners_mm[-1, 0]))
    off = (groups.z_mm - height_mm) / groups.sigma_mm
    return float(STATED_PARAMETERS * math.log(len(off)) + np.minimum(off * off, FARTHEST).sum())


@kernel(allocates=True)
def cut_into_pieces(y: Float64, z: Float64, sigma: Float64, penalty: float, ends: Int64) -> tuple[float, int]:
    """Cut points (n,), y rising, into the straight pieces of the least cost; return it and their number.

    A piece costs its line's chi2 and the penalty; `ends` (n,) gets where each piece ends, exclusive.
    """
    n = y.shape[0]
    sums = np.zeros((n + 1, 6))
    for i in range(n):
        w = 1.0 / (sigma[i] * sigma[i])
        sums[i + 1, 0] = sums[i, 0] + w
        sums[i + 1, 1] = sums[i, 1] + w * y[i]
        sums[i + 1, 2] = sums[i, 2] + w * z[i]
        sums[i + 1, 3] = sums[i, 3] + w * y[i] * y[i]
        sums[i + 1, 4] = sums[i, 4] + w * y[i] * z[i]
        sums[i + 1, 5] = sums[i, 5] + w * z[i] * z[i]
    best, start = np.empty(n + 1), np.zeros(n + 1, dtype=np.int64)
    best[0] = -penalty
    for j in range(1, n + 1):
        best[j] = math.inf
        for i in range(j):
            w = sums[j, 0] - sums[i, 0]
            wy, wz = sums[j, 1] - sums[i, 1], sums[j, 2] - sums[i, 2]
            yy = sums[j, 3] - sums[i, 3] - wy * wy / w
            yz = sums[j, 4] - sums[i, 4] - wy * wz / w
            zz = sums[j, 5] - sums[i, 5] - wz * wz / w
            chi2 = zz - yz * yz / yy if j - i > 2 and yy > 0.0 else (0.0 if j - i <= 2 else zz)
            cost = best[i] + max(chi2, 0.0) + penalty
            if cost < best[j]:
                best[j], start[j] = cost, i
    count, j = 0, n
    while j > 0:
        ends[count] = j
        count += 1
        j = int(start[j])
    for i in range(count // 2):
        ends[i], ends[count - 1 - i] = ends[count - 1 - i], ends[i]
    return float(best[n] + penalty), count


def family_shown(groups: Groups) -> tuple[JointFamily | None, float]:
    """Return the family that groups look like, None for none known, and the cost of their straight pieces."""
    n = len(groups.y_mm)
    if n < GROUPS // 4:
        return None, math.inf
    ends = np.empty(n, dtype=np.int64)
    cost, n_pieces = cut_into_pieces(*groups, 3.0 * math.log(n), ends)
    return _family(groups, ends[:n_pieces].tolist()), cost


class _PieceLine(NamedTuple):
    """A straight line through (y, z), dz/dy its slope."""

    y: float
    z: float
    slope: float

    @classmethod
    def through(cls, groups: Groups, first: int, end: int) -> _PieceLine:
        """Return the least-squares line through the groups from `first` on and before `end`."""
        y_mm, z_mm = groups.y_mm[first:end], groups.z_mm[first:end]
        y, z = float(y_mm.mean()), float(z_mm.mean())
        spread = float(((y_mm - y) ** 2).sum())
        return cls(y, z, float(((y_mm - y) * (z_mm - z)).sum()) / spread if spread > 0.0 else 0.0)

    def at(self, y: Any) -> Any:
        """Return the line's z at a place or at places (n,)."""
        return self.z + self.slope * (y - self.y)


def _family(groups: Groups, ends: list[int]) -> JointFamily | None:
    """Return the family that pieces look like, None for nothing known; `ends` are exclusive."""
    if len(ends) == 1:
        return JointFamily.FLAT
    y, n = groups.y_mm, len(groups.y_mm)
    right_end, left_start = ends[0], ends[-2]
    if right_end < MIN_BEVEL_GROUPS or n - left_start < MIN_BEVEL_GROUPS:
        return None
    right, left = _PieceLine.through(groups, 0, right_end), _PieceLine.through(groups, left_start, n)
    turn_deg = math.degrees(math.atan(left.slope) - math.atan(right.slope))
    if abs(turn_deg) > MIN_CORNER_DEG:
        # What crosses the stripe at the image's rim makes a short piece there, and no plate.
        if min(y[right_end - 1] - y[0], y[-1] - y[left_start]) < CORNER_OFF_MM:
            return None
        meet = (right.at(0.0) - left.at(0.0)) / (left.slope - right.slope)
        if not y[right_end - 1] - CORNER_OFF_MM < meet < y[left_start] + CORNER_OFF_MM:
            return None
        return JointFamily.INSIDE_CORNER if turn_deg > 0.0 else JointFamily.OUTSIDE_CORNER
    between, z = y[right_end:left_start], groups.z_mm[right_end:left_start]
    over_right, over_left = z - right.at(between), z - left.at(between)
    if np.maximum(over_right, over_left).min(initial=math.inf) < -MIN_OPENING_MM:
        return JointFamily.GROOVE if _is_bevelled(groups, ends) else JointFamily.SLOT
    if np.minimum(over_right, over_left).max(initial=-math.inf) > MIN_OPENING_MM:
        return None
    middle = 0.5 * (y[right_end - 1] + y[left_start])
    return JointFamily.STEP if abs(left.at(middle) - right.at(middle)) > MIN_STEP_MM else JointFamily.FLAT


def _is_bevelled(groups: Groups, ends: list[int]) -> bool:
    """Return True if one of the pieces between the plates' rises as a bevel does."""
    for first, end in itertools.pairwise(ends[:-1]):
        if end - first >= MIN_BEVEL_GROUPS:
            rise_mm = _PieceLine.through(groups, first, end).slope * (
                groups.y_mm[end - 1] - groups.y_mm[first]
            )
            if abs(rise_mm) > MIN_BEVEL_RISE_MM:
                return True
    return False
