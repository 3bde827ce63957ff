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
from typing import NamedTuple, overload

import numpy as np

from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from noise_model.surface.joint import Joint
from tracker.joint.measured import MeasuredJoint
from tracker.joint.plate_lines import BLURRED_LINES
from tracker.profile import Profile

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


def family_of(joint: Joint) -> Family | None:
    """Return the family of a stated joint; None for an edge, which shows no plates to tell it by."""
    if joint.type == "fillet":
        inside = joint.dimensions["included_angle_deg"] < 180.0
        return Family.INSIDE_CORNER if inside else Family.OUTSIDE_CORNER
    return FAMILIES.get(joint.type)


def is_another_type(profile: Profile, joint: Joint, measured: MeasuredJoint | None) -> bool:
    """Say whether a profile shows another family of joints than the stated one, decidedly.

    `measured` is the stated type's fit, None where there is none.
    """
    stated = family_of(joint)
    if stated is None:
        return False
    family, cost = shown_family(profile)
    if family is None or family is stated:
        return False
    if stated is Family.SLOT and family is Family.FLAT:
        # A gap may show nothing but missing points, and a narrow one not even those.
        is_shown = joint.dimensions["gap_mm"] >= BLURRED_LINES * profile.column_mm
        return measured is None and is_shown
    return measured is None or cost + DECIDED < _stated_cost(*_groups(profile), measured)


def shown_family(profile: Profile) -> tuple[Family | None, float]:
    """Return the family that a profile's straight pieces look like, None for none known, and their cost."""
    y, z, sigma = _groups(profile)
    if len(y) < GROUPS // 4:
        return None, math.inf
    ends = np.empty(len(y), dtype=np.int64)
    cost, n_pieces = cut_into_pieces(y, z, sigma, 3.0 * math.log(len(y)), ends)
    return _family(y, z, ends[:n_pieces]), cost


def _groups(profile: Profile) -> tuple[Float64, Float64, Float64]:
    """Return the median points of neighbouring points (n,): y and z, mm, and the sigma of z."""
    size = max(1, math.ceil(len(profile.y_mm) / GROUPS))
    n = len(profile.y_mm) // size
    z = profile.z_mm[: n * size].reshape(n, size)
    middle = np.argsort(z, axis=1)[:, (size - 1) // 2]
    medians = np.arange(n) * size + middle
    sigma = np.hypot(np.abs(profile.dz_mm[medians]) * profile.sigma_px[medians], ROUGH_MM)
    return profile.y_mm[medians], profile.z_mm[medians], sigma


def _stated_cost(y: Float64, z: Float64, sigma: Float64, measured: MeasuredJoint) -> float:
    """Return the stated type's own cost: chi2 about its fitted section and its parameters' penalty."""
    corners = measured.corners_mm
    off = (z - np.interp(y, corners[:, 0], corners[:, 1])) / sigma
    return float(np.minimum(off**2, FARTHEST).sum() + STATED_PARAMETERS * math.log(len(y)))


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


class _Line(NamedTuple):
    """A straight line through (y, z), dz/dy its slope."""

    y: float
    z: float
    slope: float

    @classmethod
    def through(cls, y: Float64, z: Float64) -> _Line:
        """Return the least-squares line through points (n,)."""
        y_mean, z_mean = float(y.mean()), float(z.mean())
        beside = y - y_mean
        spread = float(beside @ beside)
        return cls(y_mean, z_mean, float(beside @ (z - z_mean)) / spread if spread > 0.0 else 0.0)

    @overload
    def at(self, y: float) -> float: ...
    @overload
    def at(self, y: Float64) -> Float64: ...
    def at(self, y: float | Float64) -> float | Float64:
        """Return its z at a place or places."""
        return self.z + self.slope * (y - self.y)


def _family(y: Float64, z: Float64, ends: Int64) -> Family | None:
    """Return what the pieces of a profile look like, None for nothing known."""
    if len(ends) == 1:
        return Family.FLAT
    pieces = list(zip([0, *ends[:-1]], ends, strict=True))
    (_, right_end), (left_start, _) = pieces[0], pieces[-1]
    if right_end < MIN_BEVEL_GROUPS or len(y) - left_start < MIN_BEVEL_GROUPS:
        return None
    right, left = _Line.through(y[:right_end], z[:right_end]), _Line.through(y[left_start:], z[left_start:])
    turn_deg = math.degrees(math.atan(left.slope) - math.atan(right.slope))
    if abs(turn_deg) > MIN_CORNER_DEG:
        meet = (right.at(0.0) - left.at(0.0)) / (left.slope - right.slope)
        if y[right_end - 1] - CORNER_OFF_MM < meet < y[left_start] + CORNER_OFF_MM:
            return Family.INSIDE_CORNER if turn_deg > 0.0 else Family.OUTSIDE_CORNER
        return None
    middle = 0.5 * (y[right_end - 1] + y[left_start])
    step = float(left.at(middle) - right.at(middle))
    between = slice(right_end, left_start)
    over_right, over_left = (z[between] - line.at(y[between]) for line in (right, left))
    if len(over_left) and np.maximum(over_right, over_left).min() < -MIN_OPENING_MM:
        bevelled = any(
            end - first >= MIN_BEVEL_GROUPS
            and abs(_Line.through(y[first:end], z[first:end]).slope) * (y[end - 1] - y[first])
            > MIN_BEVEL_RISE_MM
            for first, end in pieces[1:-1]
        )
        return Family.GROOVE if bevelled else Family.SLOT
    if len(over_left) and np.minimum(over_right, over_left).max() > MIN_OPENING_MM:
        return None
    return Family.STEP if abs(step) > MIN_STEP_MM else Family.FLAT
