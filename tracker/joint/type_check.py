"""The stated type of joint against what the profile shows: straight pieces with change points, penalised.

The profile is cut into straight pieces so that the sum over them of chi2 + 3 ln n is least: each piece costs
its two parameters and its change point (Schwarz 1978, Annals of Statistics 6, 461; the optimal partition by
Jackson et al. 2005, IEEE Signal Processing Letters 12, 105). What the pieces look like is a family of joints.
The stated type is doubted where that is another one, and explains the profile decidedly better than the
stated type's own fit does.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from noise_model.surface.joint import Joint
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.measured import MeasuredJoint, section_at
from tracker.joint.plate_lines import BLURRED_LINES
from tracker.state import DZ_MM, SIGMA_PX, Y_MM, Z_MM

GROUPS = 120
"""About so many groups of neighbouring points, each its median, are cut into pieces."""

ROUGH_MM = 0.05
"""What a point may lie off a piece beyond its noise: types differ by more than parts do from drawings."""

MIN_OPENING_MM, MIN_STEP_MM = 0.4, 0.3
"""How deep an opening and how high a step are at least."""

MIN_CORNER_DEG, MIN_BEVEL_RISE_MM = 12.0, 0.8
"""Plates that are turned by more form a corner; a piece that rises by more between plates is a bevel."""

MIN_BEVEL_GROUPS = 3
"""Fewer groups than this are no bevel: two may lie on either side of an upright edge."""

CORNER_OFF_MM = 1.5
"""So far from where the plates' pieces end their lines may meet in a corner."""

DECIDED = 30.0
"""Another family must be better by this much of chi2: e^15 to 1."""

STATED_PARAMETERS = 10
"""As many as the shape has that has most."""

FARTHEST = 25.0
"""What one group may add to the stated type's chi2."""


class Family(Enum):
    """What a profile's pieces look like."""

    FLAT = "a plate"
    INSIDE_CORNER = "two plates that rise from a corner"
    OUTSIDE_CORNER = "two plates that fall from a corner"
    STEP = "two sheets, one higher"
    SLOT = "two plates and an upright gap"
    GROOVE = "two plates and a bevelled groove"


FAMILIES = {
    "v_groove": Family.GROOVE,
    "half_v": Family.GROOVE,
    "u_groove": Family.GROOVE,
    "lap": Family.STEP,
    "corrugation": Family.STEP,
    "butt": Family.SLOT,
}

_NUMBERED = tuple(Family)
_NONE = -1
_FLAT, _INSIDE_CORNER, _OUTSIDE_CORNER, _STEP, _SLOT, _GROOVE = range(len(_NUMBERED))


def family_of(joint: Joint) -> Family | None:
    """Return the family of a stated joint; None for an edge, which shows no plates to tell it by."""
    if joint.type == "fillet":
        inside = joint.dimensions["included_angle_deg"] < 180.0
        return Family.INSIDE_CORNER if inside else Family.OUTSIDE_CORNER
    return FAMILIES.get(joint.type)


def number_of(family: Family | None) -> int:
    """Return the number of a family, as the kernels take it."""
    return _NONE if family is None else _NUMBERED.index(family)


def shown_family(points: Float64) -> tuple[Family | None, float]:
    """Return the family that a section's straight pieces look like, None for none known, and their cost."""
    number, cost = family_shown(groups_of(points))
    return (None if number == _NONE else _NUMBERED[number]), cost


@kernel(allocates=True)
def shows_another(
    points: Float64, column_mm: float, family: int, stated: StatedJoint, measured: MeasuredJoint
) -> bool:
    """Say whether points show another family of joints than the stated one, by its number, decidedly.

    `column_mm` is the spacing of their scan lines. `measured` is the stated type's fit, undetermined where
    there is none.
    """
    if family == _NONE:
        return False
    groups = groups_of(points)
    shown, cost = family_shown(groups)
    if shown in (_NONE, family):
        return False
    is_fitted = not math.isnan(measured.y_mm)
    if family == _SLOT and shown == _FLAT:
        # A gap may show nothing but missing points, and a narrow one not even those.
        return not is_fitted and stated.gap_mm >= BLURRED_LINES * column_mm
    return not is_fitted or cost + DECIDED < stated_cost(groups, measured.corners_mm)


class Groups(NamedTuple):
    """The median points (n,) of neighbouring points: y and z, mm, and the sigma of z."""

    y_mm: Float64
    z_mm: Float64
    sigma_mm: Float64


@kernel(allocates=True)
def groups_of(points: Float64) -> Groups:
    """Return the groups of points, y rising."""
    size = max(1, -(-points[Y_MM].shape[0] // GROUPS))
    n = points[Y_MM].shape[0] // size
    groups = Groups(np.empty(n), np.empty(n), np.empty(n))
    _write_groups(points, groups, np.empty(size, np.int64))
    return groups


@kernel
def _write_groups(points: Float64, groups: Groups, order: Int64) -> None:
    """Write the groups of points, each as large as `order`, which is written over."""
    z, size = points[Z_MM], order.shape[0]
    for i in range(groups.y_mm.shape[0]):
        for k in range(size):
            place, j = i * size + k, k
            while j > 0 and z[order[j - 1]] > z[place]:
                order[j] = order[j - 1]
                j -= 1
            order[j] = place
        middle = order[(size - 1) // 2]
        groups.y_mm[i], groups.z_mm[i] = points[Y_MM, middle], z[middle]
        groups.sigma_mm[i] = math.hypot(abs(points[DZ_MM, middle]) * points[SIGMA_PX, middle], ROUGH_MM)


@kernel(allocates=True)
def stated_cost(groups: Groups, corners_mm: Float64) -> float:
    """Return the stated type's own cost: chi2 about its fitted section (m, 2) and its parameters' penalty."""
    n = groups.y_mm.shape[0]
    # Beyond its ends a section goes on level.
    within_mm = np.minimum(np.maximum(groups.y_mm, corners_mm[0, 0]), corners_mm[-1, 0])
    height_mm, _ = section_at(corners_mm, within_mm)
    cost = STATED_PARAMETERS * math.log(n)
    for i in range(n):
        cost += min(((groups.z_mm[i] - height_mm[i]) / groups.sigma_mm[i]) ** 2, FARTHEST)
    return cost


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


@kernel(allocates=True)
def family_shown(groups: Groups) -> tuple[int, float]:
    """Return the number of the family that groups look like, and the cost of their straight pieces."""
    n = groups.y_mm.shape[0]
    if n < GROUPS // 4:
        return _NONE, math.inf
    ends = np.empty(n, dtype=np.int64)
    cost, n_pieces = cut_into_pieces(groups.y_mm, groups.z_mm, groups.sigma_mm, 3.0 * math.log(n), ends)
    return _family(groups, ends, n_pieces), cost


class _Line(NamedTuple):
    """A straight line through (y, z), dz/dy its slope."""

    y: float
    z: float
    slope: float


@kernel
def _line_through(groups: Groups, first: int, end: int) -> _Line:
    """Return the least-squares line through the groups from `first` on and before `end`."""
    n, y, z = end - first, 0.0, 0.0
    for i in range(first, end):
        y += groups.y_mm[i] / n
        z += groups.z_mm[i] / n
    spread, along = 0.0, 0.0
    for i in range(first, end):
        beside = groups.y_mm[i] - y
        spread += beside * beside
        along += beside * (groups.z_mm[i] - z)
    return _Line(y, z, along / spread if spread > 0.0 else 0.0)


@kernel
def _z_on(line: _Line, y: float) -> float:
    """Return a line's z at a place."""
    z: float = line.z + line.slope * (y - line.y)
    return z


@kernel
def _family(groups: Groups, ends: Int64, n_pieces: int) -> int:
    """Return the number of what pieces look like, _NONE for nothing known; `ends` are exclusive."""
    if n_pieces == 1:
        return _FLAT
    y, n = groups.y_mm, groups.y_mm.shape[0]
    right_end, left_start = ends[0], ends[n_pieces - 2]
    if right_end < MIN_BEVEL_GROUPS or n - left_start < MIN_BEVEL_GROUPS:
        return _NONE
    right, left = _line_through(groups, 0, right_end), _line_through(groups, left_start, n)
    turn_deg = math.degrees(math.atan(left.slope) - math.atan(right.slope))
    if abs(turn_deg) > MIN_CORNER_DEG:
        meet = (_z_on(right, 0.0) - _z_on(left, 0.0)) / (left.slope - right.slope)
        if not y[right_end - 1] - CORNER_OFF_MM < meet < y[left_start] + CORNER_OFF_MM:
            return _NONE
        return _INSIDE_CORNER if turn_deg > 0.0 else _OUTSIDE_CORNER
    middle = 0.5 * (y[right_end - 1] + y[left_start])
    step = _z_on(left, middle) - _z_on(right, middle)
    below_both, above_both = math.inf, -math.inf
    for i in range(right_end, left_start):
        over_right = groups.z_mm[i] - _z_on(right, y[i])
        over_left = groups.z_mm[i] - _z_on(left, y[i])
        below_both = min(below_both, max(over_right, over_left))
        above_both = max(above_both, min(over_right, over_left))
    if below_both < -MIN_OPENING_MM:
        return _GROOVE if _is_bevelled(groups, ends, n_pieces) else _SLOT
    if above_both > MIN_OPENING_MM:
        return _NONE
    return _STEP if abs(step) > MIN_STEP_MM else _FLAT


@kernel
def _is_bevelled(groups: Groups, ends: Int64, n_pieces: int) -> bool:
    """Say whether one of the pieces between the plates' rises as a bevel does."""
    for piece in range(1, n_pieces - 1):
        first, end = ends[piece - 1], ends[piece]
        if end - first >= MIN_BEVEL_GROUPS:
            rise_mm = _line_through(groups, first, end).slope * (groups.y_mm[end - 1] - groups.y_mm[first])
            if abs(rise_mm) > MIN_BEVEL_RISE_MM:
                return True
    return False
