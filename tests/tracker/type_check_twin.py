"""The type check's kernels in plain NumPy."""

from __future__ import annotations

import math
from typing import NamedTuple, overload

import numpy as np
from profiles import Profile

from noise_model.arrays import Float64, Int64
from tracker.joint.measured import MeasuredJoint
from tracker.joint.type_check import (
    CORNER_OFF_MM,
    FARTHEST,
    GROUPS,
    MIN_BEVEL_GROUPS,
    MIN_BEVEL_RISE_MM,
    MIN_CORNER_DEG,
    MIN_OPENING_MM,
    MIN_STEP_MM,
    ROUGH_MM,
    STATED_PARAMETERS,
    Family,
)


def groups(profile: Profile) -> tuple[Float64, Float64, Float64]:
    """Return the median points of neighbouring points (n,): y and z, mm, and the sigma of z."""
    size = max(1, math.ceil(len(profile.y_mm) / GROUPS))
    n = len(profile.y_mm) // size
    z = profile.z_mm[: n * size].reshape(n, size)
    middle = np.argsort(z, axis=1)[:, (size - 1) // 2]
    medians = np.arange(n) * size + middle
    sigma = np.hypot(np.abs(profile.dz_mm[medians]) * profile.sigma_px[medians], ROUGH_MM)
    return profile.y_mm[medians], profile.z_mm[medians], sigma


def stated_cost(y: Float64, z: Float64, sigma: Float64, measured: MeasuredJoint) -> float:
    """Return the stated type's own cost: chi2 about its fitted section and its parameters' penalty."""
    corners = measured.corners_mm
    off = (z - np.interp(y, corners[:, 0], corners[:, 1])) / sigma
    return float(np.minimum(off**2, FARTHEST).sum() + STATED_PARAMETERS * math.log(len(y)))


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


def family(y: Float64, z: Float64, ends: Int64) -> Family | None:
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
