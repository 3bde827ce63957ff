"""Errors of a setup's calibrated values: their joint covariance, and the camera and sheet that have them.

Lens, camera pose and laser sheet are calibrated together, so their errors go together: what each has wrong
cancels in part where the seam is concerned. A setup without a calibration has its tolerance as the covariance
of the same parameters: the camera's pose before a sheet that is exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.transforms import moved

if TYPE_CHECKING:
    from noise_model.instrument.camera import Camera
    from noise_model.instrument.laser import Laser
    from noise_model.setup_keys import Tolerance

PINHOLE = ("fx", "fy", "cx", "cy")
OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's distortion in its order; tau_x and tau_y, rad, tilt the sensor."""

POSE = ("rot_x_deg", "rot_y_deg", "rot_z_deg", "move_x_mm", "move_y_mm", "move_z_mm")
"""A small motion of the camera in its own frame, as `noise_model.transforms.moved` applies it."""

SHEET = ("n_x", "n_y", "n_z", "d_mm")
"""The laser sheet's plane in the tool frame."""

BOW = "bow"
"""The way of the sheet from its plane, see `noise_model.instrument.laser.Laser`."""

TOOL = ("tool_x_mm", "tool_y_mm", "tool_z_mm")
"""A displacement of the tool in its own frame: its way in an unknown delay."""

NAMES = (*PINHOLE, *OPENCV, *POSE, *SHEET, BOW, *TOOL)


ROUNDING = 1e-12
"""Variance of a correlation's principal axis, of some dozen rows, below which it is rounding."""


@dataclass(frozen=True)
class CalibrationCovariance:
    """Joint covariance of a setup's calibrated values.

    `names` (n,) are those of `NAMES` that are not exact, `rows` (n, n) their covariance in px, deg, mm and
    the distortion's own units. Raises ValueError for a name that is unknown or stands twice, and for rows
    that are no covariance.
    """

    names: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in NAMES]
        if unknown or len({*self.names}) != len(self.names):
            what = f"{unknown[0]!r} is none of {', '.join(NAMES)}" if unknown else "a name stands twice"
            raise ValueError(f"parameters: {what}")
        correlation = self._correlation
        variance = np.linalg.eigvalsh(correlation)
        # Files may have six digits.
        if not np.allclose(correlation, correlation.T, 0.0, 1e-6) or variance.min(initial=0.0) < -1e-6:
            raise ValueError("covariance: must be symmetric, with no negative variance in any direction")

    @classmethod
    def of(cls, names: Sequence[str], matrix: Float64) -> CalibrationCovariance:
        """Return that of an array (n, n)."""
        return cls(tuple(names), tuple(map(tuple, matrix.tolist())))

    @classmethod
    @lru_cache(maxsize=8)
    def of_tolerance(cls, tolerance: Tolerance) -> CalibrationCovariance:
        """Return that of a camera pose within its tolerance, before an exact sheet."""
        sigma = np.repeat([tolerance.hand_eye_deg, tolerance.hand_eye_mm], 3)
        return cls.of(POSE, np.diag(sigma**2))

    @classmethod
    def sum(cls, parts: Iterable[CalibrationCovariance]) -> CalibrationCovariance:
        """Return that of independent errors together."""
        parts = tuple(parts)
        names = tuple(dict.fromkeys(name for part in parts for name in part.names))
        whole = np.zeros((len(names), len(names)))
        for part in parts:
            rows = [names.index(name) for name in part.names]
            whole[np.ix_(rows, rows)] += part.matrix
        is_open = np.flatnonzero(np.diag(whole))
        return cls.of([names[n] for n in is_open], whole[np.ix_(is_open, is_open)])

    @property
    def matrix(self) -> Float64:
        """The covariance (n, n)."""
        return np.array(self.rows).reshape(len(self.names), len(self.names))

    def sigmas(self, names: Sequence[str]) -> Float64:
        """Return 1 sigma of values (n,), 0 for exact ones."""
        known = dict(zip(self.names, self._scale.tolist(), strict=True))
        return np.array([known.get(name, 0.0) for name in names])

    @cached_property
    def modes(self) -> Float64:
        """Independent errors (m, n) of 1 sigma each, the principal axes of the correlation."""
        variance, directions = np.linalg.eigh(self._correlation)
        size = np.sqrt(np.maximum(variance, 0.0))
        # Of either sign alike: a tolerance's are those of its parameters themselves.
        sign = np.where(directions.sum(axis=0) < 0.0, -1.0, 1.0)
        return np.asarray((sign * size * directions).T * self._scale)[variance > ROUNDING]

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Names of the sizes of the independent errors, by which a fit has them."""
        return tuple(f"calibration_{n}" for n in range(len(self.modes)))

    def modes_of(self, names: Sequence[str]) -> Float64:
        """Return what the independent errors (m, n) do to some values, nothing to exact ones."""
        places = [self.names.index(name) if name in self.names else -1 for name in names]
        return np.pad(self.modes, ((0, 0), (0, 1)))[:, places]

    @property
    def _scale(self) -> Float64:
        # A negative variance shows in the correlation.
        return np.asarray(np.sqrt(np.abs(np.diag(self.matrix))))

    @property
    def _correlation(self) -> Float64:
        """The correlation (n, n), zeros for an exact parameter."""
        scale = np.outer(self._scale, self._scale)
        return np.divide(self.matrix, scale, out=np.zeros_like(scale), where=scale > 0.0)

    def errors(self, sizes: Float64) -> dict[str, float]:
        """Return the error of each value where its independent errors have `sizes` (m,), in sigmas."""
        return dict(zip(self.names, (sizes @ self.modes).tolist(), strict=True))


def tool_displacement(errors: Mapping[str, float]) -> Float64:
    """Return the displacement of the tool (3,), mm, in its own frame."""
    return np.array([errors.get(name, 0.0) for name in TOOL])


def camera_with_errors(camera: Camera, errors: Mapping[str, float]) -> Camera:
    """Return the camera whose lens and pose are off by errors, by name."""
    motion = [errors.get(name, 0.0) for name in POSE]
    distortion = camera.distortion
    if any(name in errors for name in OPENCV):
        off = [errors.get(name, 0.0) for name in OPENCV]
        full = np.pad(distortion, (0, len(OPENCV) - len(distortion))) + off
        distortion = tuple(full.tolist())
    return replace(
        camera,
        **{name: getattr(camera, name) + errors.get(name, 0.0) for name in PINHOLE},
        distortion=distortion,
        T_tool_camera=moved(camera.T_tool_camera, motion[:3], motion[3:]),
    )


def laser_with_errors(laser: Laser, errors: Mapping[str, float]) -> Laser:
    """Return a sheet whose plane is off; its origin goes with it, at its height."""
    if not any(name in errors for name in (*SHEET, BOW)):
        return laser
    plane = laser.plane + [errors.get(name, 0.0) for name in SHEET]
    plane /= np.linalg.norm(plane[:3])
    n_x, n_y, n_z, d_mm = plane.tolist()
    x, y, z = laser.origin_in_tool_mm
    off = (n_x * x + n_y * y + n_z * z + d_mm) / (n_x**2 + n_y**2)
    origin_mm = (x - off * n_x, y - off * n_y, z)
    return replace(
        laser,
        plane_in_tool=(n_x, n_y, n_z, d_mm),
        origin_in_tool_mm=origin_mm,
        bow=laser.bow + errors.get(BOW, 0.0),
    )
