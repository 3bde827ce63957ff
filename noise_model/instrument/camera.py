"""Image formation: pinhole, lens distortion, cos^4 fall-off (Eq. 18) and the point-spread function."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64, Integers
from noise_model.compiled.kernel import kernel
from noise_model.setup_keys import COEFFICIENTS

NARROW_PX = 0.65
"""Below this 1 sigma a Gaussian sampled at the pixel centres is narrower than it should be."""


MONOCHROME = ("mono", "gray", "grey")
"""First letters of the name of a pixel format without colour."""


@dataclass(frozen=True)
class Camera:
    """The camera as stated, with OpenCV's axes and intrinsics; pixel centres lie at integers.

    Parameters
    ----------
    width, height : int
        The image's size, px.
    fx, fy : float
        Focal lengths, px.
    cx, cy : float
        The principal point, px.
    T_tool_camera : array (4, 4)
        The camera's pose: it takes points of the camera frame to the tool frame, mm.
    distortion : tuple (5,), (8,) or (14,)
        OpenCV's k1, k2, p1, p2, k3; then k4, k5, k6; then s1 to s4 and the sensor's tilts, rad.
    focal_length_mm : float
        The lens' focal length, mm.
    f_number : float
        The lens' f-number.
    psf_sigma_px : float
        1 sigma of the point-spread function, px: a Gaussian that includes the pixel's own aperture.
    exposure_s : float
        The nominal exposure, s.
    pixel_format : str
        A monochrome format, such as "mono8".

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    T_tool_camera: Float64
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    focal_length_mm: float = 16.0
    f_number: float = 8.0
    psf_sigma_px: float = 0.7
    exposure_s: float = 0.005
    pixel_format: str = "mono8"

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"[camera] width, height: {self.width} x {self.height} is no image")
        for name in ("fx", "fy", "focal_length_mm", "f_number", "exposure_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[camera] {name} = {getattr(self, name)}: must be > 0")
        if not self.psf_sigma_px >= 0:
            raise ValueError(f"[camera] psf_sigma_px = {self.psf_sigma_px}: must be >= 0")
        if len(self.distortion) not in COEFFICIENTS:
            raise ValueError(
                "[camera] distortion: needs the five values k1 k2 p1 p2 k3, or OpenCV's first 8 or 14"
            )
        if not self.pixel_format.lower().startswith(MONOCHROME):
            raise ValueError(
                f"[camera] pixel_format = {self.pixel_format!r}: must be a monochrome one, such as mono8"
            )

    def __str__(self) -> str:
        fields_deg = [
            math.degrees(2.0 * math.atan(size / 2.0 / focal))
            for size, focal in ((self.width, self.fx), (self.height, self.fy))
        ]
        x_mm, y_mm, z_mm = self.T_tool_camera[:3, 3]
        down_deg = math.degrees(math.acos(np.clip(-self.T_tool_camera[2, 2], -1.0, 1.0)))
        return (
            f"{self.width} x {self.height} px, {self.focal_length_mm:g} mm f/{self.f_number:g}, "
            f"field {fields_deg[0]:.1f} x {fields_deg[1]:.1f} deg, PSF {self.psf_sigma_px:g} px; "
            f"at ({x_mm:.1f}, {y_mm:.1f}, {z_mm:.1f}) mm in tool, {down_deg:.1f} deg off straight down"
        )

    @property
    def geometry(self) -> tuple[int, int, float, float, float, float, tuple[float, ...]]:
        """All that its rays depend on, to compare by: size, fx, fy, cx, cy, distortion; its pose is not."""
        return self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion

    @cached_property
    def intrinsics(self) -> Intrinsics:
        """Projection of a point and its ray, for the kernels."""
        given = np.array([*self.distortion, *np.zeros(max(COEFFICIENTS) - len(self.distortion))])
        k1, k2, p1, p2, k3 = given[:5].tolist()
        k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = given[5:].tolist()
        return Intrinsics(
            fx=float(self.fx),
            fy=float(self.fy),
            cx=float(self.cx),
            cy=float(self.cy),
            distortion=(k1, k2, p1, p2, k3),
            denominator=(k4, k5, k6),
            prism=(s1, s2, s3, s4),
            tilt=tilt_numbers(tau_x, tau_y),
        )

    @property
    def matrix(self) -> Float64:
        """The 3x3 intrinsic matrix, px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def coarser(self, by: int) -> Camera:
        """Return the camera with so many times larger pixels; a rest at the rim that fills none is left out.

        The point-spread function stays as many pixels wide.
        """
        return replace(
            self,
            width=self.width // by,
            height=self.height // by,
            fx=self.fx / by,
            fy=self.fy / by,
            cx=(self.cx + 0.5) / by - 0.5,
            cy=(self.cy + 0.5) / by - 0.5,
        )

    def normalised(self, points_px: npt.ArrayLike) -> Float64:
        """Return the undistorted normalised coordinates of image points.

        Parameters
        ----------
        points_px : array (N, 2)
            Image points, px.

        Returns
        -------
        array (N, 2)
            x and y; the ray is (x, y, 1) in the camera frame.
        """
        points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
        # OpenCV has no answer to no points.
        if not any(self.distortion) or not len(points):
            flat = points[:, 0]
            return np.column_stack([(flat[:, 0] - self.cx) / self.fx, (flat[:, 1] - self.cy) / self.fy])
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        undistorted = cv2.undistortPointsIter(
            points, self.matrix, np.asarray(self.distortion), np.eye(3), np.eye(3), criteria
        )
        xy = np.asarray(undistorted, dtype=np.float64)[:, 0]
        # OpenCV's fixed points come near slowly, or never, where the distortion is strong.
        far = np.flatnonzero(~(self._misses_px(xy, points[:, 0]) <= MAX_MISS_PX))
        if len(far):
            by_newton = undistorted_rays(points[far, 0], self.matrix, np.asarray(self.distortion))
            is_hit = self._misses_px(by_newton, points[far, 0]) <= MAX_MISS_PX
            xy[far[is_hit]] = by_newton[is_hit]
        return xy

    def _misses_px(self, xy: Float64, points_px: Float64) -> Float64:
        """Return the distances of image points (N, 2) from projected rays (N, 2), px."""
        seen = self.project(np.column_stack([xy, np.ones(len(xy))]))
        return np.asarray(np.abs(seen - points_px).max(axis=1))

    def project(self, points_camera: Float64) -> Float64:
        """Return the image points of points in front of the camera.

        Parameters
        ----------
        points_camera : array (N, 3)
            Points, mm, camera frame.

        Returns
        -------
        array (N, 2)
            Image points, px.
        """
        if not len(points_camera):
            return np.empty((0, 2))
        image, _ = cv2.projectPoints(
            np.ascontiguousarray(points_camera, dtype=np.float64).reshape(-1, 1, 3),
            np.zeros(3),
            np.zeros(3),
            self.matrix,
            np.asarray(self.distortion),
        )
        return np.asarray(image, dtype=np.float64)[:, 0]


Nine = tuple[float, float, float, float, float, float, float, float, float]


class Intrinsics(NamedTuple):
    """A camera's OpenCV intrinsics as the kernels take them, px; distortion is k1 k2 p1 p2 k3.

    What follows is k4 k5 k6, s1 to s4, and the tilted sensor's matrix row by row.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]
    denominator: tuple[float, float, float]
    prism: tuple[float, float, float, float]
    tilt: Nine


def tilt_numbers(tau_x: float, tau_y: float) -> Nine:
    """Return the matrix, row by row, that takes a straight sensor's image to that of a tilted one.

    It is that of OpenCV's tilted model; angles are in rad.
    """
    cx, sx, cy, sy = math.cos(tau_x), math.sin(tau_x), math.cos(tau_y), math.sin(tau_y)
    R = np.array([[cy, sy * sx, -sy * cx], [0.0, cx, sx], [sy, -cy * sx, cy * cx]])
    shifted = np.array([[R[2, 2], 0.0, -R[0, 2]], [0.0, R[2, 2], -R[1, 2]], [0.0, 0.0, 1.0]]) @ R
    a, b, c, d, e, f, g, h, i = shifted.ravel().tolist()
    return a, b, c, d, e, f, g, h, i


@kernel
def distorted(x: float, y: float, lens: Intrinsics) -> tuple[float, float, float, float, float, float]:
    """Return the distorted place of a ray (x, y, 1): X, Y, dX/dx, dX/dy, dY/dx, dY/dy.

    OpenCV's rational, thin prism and tilted models, before focal lengths and principal point.
    """
    k1, k2, p1, p2, k3 = lens.distortion
    k4, k5, k6 = lens.denominator
    s1, s2, s3, s4 = lens.prism
    q = x * x + y * y
    over, under = 1.0 + q * (k1 + q * (k2 + q * k3)), 1.0 + q * (k4 + q * (k5 + q * k6))
    radial = over / under
    rise = (k1 + q * (2.0 * k2 + q * 3.0 * k3) - radial * (k4 + q * (2.0 * k5 + q * 3.0 * k6))) / under
    u = x * radial + 2.0 * p1 * x * y + p2 * (q + 2.0 * x * x) + q * (s1 + q * s2)
    v = y * radial + p1 * (q + 2.0 * y * y) + 2.0 * p2 * x * y + q * (s3 + q * s4)
    mixed = 2.0 * x * y * rise + 2.0 * p1 * x + 2.0 * p2 * y
    prism_u, prism_v = 2.0 * (s1 + 2.0 * q * s2), 2.0 * (s3 + 2.0 * q * s4)
    u_x = radial + 2.0 * x * x * rise + 2.0 * p1 * y + 6.0 * p2 * x + prism_u * x
    u_y, v_x = mixed + prism_u * y, mixed + prism_v * x
    v_y = radial + 2.0 * y * y * rise + 6.0 * p1 * y + 2.0 * p2 * x + prism_v * y
    a, b, c, d, e, f, g, h, i = lens.tilt
    w = g * u + h * v + i
    X, Y = (a * u + b * v + c) / w, (d * u + e * v + f) / w
    a, b, d, e = (a - g * X) / w, (b - h * X) / w, (d - g * Y) / w, (e - h * Y) / w
    return X, Y, a * u_x + b * v_x, a * u_y + b * v_y, d * u_x + e * v_x, d * u_y + e * v_y


UNDISTORT_STEPS, UNDISTORTED = 20, 1e-12
"""Newton steps by which a lens' distortion is undone at most; one that is shorter is the last."""

LONGEST_STEP = 0.3
"""The longest step from a pixel's ray, slope: where the lens folds the steps would have no end."""

MAX_MISS_PX = 1e-7
"""A ray that is seen farther than this from its image point is sought anew."""


def undistorted_rays(points_px: Float64, matrix: Float64, distortion: Float64) -> Float64:
    """Return the normalised coordinates of image points, by Newton's steps from the distorted places.

    `points_px` (N, 2) are image points, `matrix` (3, 3) is the intrinsic matrix, px, `distortion` (n,)
    OpenCV's coefficients. x and y (N, 2) of the rays (x, y, 1); where the lens folds and has no such point,
    anything.
    """
    rays = np.column_stack([(points_px - matrix[:2, 2]) / np.diag(matrix)[:2], np.ones(len(points_px))])
    for _ in range(UNDISTORT_STEPS):
        seen, slopes = cv2.projectPoints(rays[:, np.newaxis], np.zeros(3), np.zeros(3), matrix, distortion)
        # Columns 3 and 4: OpenCV gives the slopes by a shift of the camera, here of a ray at z = 1.
        per_ray = slopes.reshape(len(rays), 2, -1)[:, :, 3:5]
        step = np.linalg.solve(per_ray, (points_px - seen[:, 0])[:, :, np.newaxis])[:, :, 0]
        rays[:, :2] += step.clip(-LONGEST_STEP, LONGEST_STEP)
        if np.abs(step).max(initial=0.0) < UNDISTORTED:
            break
    return rays[:, :2]


@kernel
def undistorted(u: float, v: float, lens: Intrinsics) -> tuple[float, float, float, float, float, float]:
    """Return an image point's normalised coordinates x, y and their derivatives dx/du, dx/dv, dy/du, dy/dv.

    OpenCV's distortion is undone by Newton's steps from the distorted place.
    """
    to_x, to_y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    x, y = to_x, to_y
    xx, xy, yx, yy, determinant = 1.0, 0.0, 0.0, 1.0, 1.0
    for _ in range(UNDISTORT_STEPS):
        X, Y, xx, xy, yx, yy = distorted(x, y, lens)
        determinant = xx * yy - xy * yx
        off_x, off_y = X - to_x, Y - to_y
        step_x = (yy * off_x - xy * off_y) / determinant
        step_y = (xx * off_y - yx * off_x) / determinant
        x -= step_x
        y -= step_y
        if abs(step_x) + abs(step_y) < UNDISTORTED:
            break
    per_u, per_v = 1.0 / (determinant * lens.fx), 1.0 / (determinant * lens.fy)
    return x, y, yy * per_u, -xy * per_v, -yx * per_u, xx * per_v


def fall_off(xy: Float64) -> Float64:
    """Return the lens' fall-off cos^4 (...,) of normalised rays (..., 2), 1 on the optical axis (Eq. 18)."""
    return np.asarray((1.0 + np.sum(xy**2, axis=-1)) ** -2.0)


@dataclass(frozen=True)
class Rays:
    """Viewing rays of pixels (...,) in the camera frame: of a whole image (H, W), or of some of it, (n,).

    `uv_px` (..., 2) are the pixels' places as (u, v), `xy` (..., 2) their rays (x, y, 1), not normalised;
    `cos4` (...,) is the lens' fall-off cos^4 of the field angle, 1 on the optical axis (Eq. 18).
    """

    uv_px: Float32 = field(repr=False)
    xy: Float32
    cos4: Float32 = field(repr=False)

    @classmethod
    def of(cls, camera: Camera) -> Rays:
        """Trace every pixel centre of a camera (H, W)."""
        v, u = np.mgrid[: camera.height, : camera.width]
        return cls.through(camera, np.stack([u, v], axis=-1))

    @classmethod
    def through(cls, camera: Camera, uv_px: Float64 | Int64) -> Rays:
        """Trace places (..., 2) of an image, px."""
        xy = camera.normalised(uv_px.reshape(-1, 2))
        return cls(
            uv_px.astype(np.float32),
            np.ascontiguousarray(xy.astype(np.float32).reshape(uv_px.shape)),
            fall_off(xy).astype(np.float32).reshape(uv_px.shape[:-1]),
        )

    def at(self, pixels: Integers | Bool) -> Rays:
        """Return the rays (n,) of some pixels, by their places in the flattened image."""
        flat = self.flat
        return Rays(flat.uv_px[pixels], flat.xy[pixels], flat.cos4[pixels])

    @property
    def flat(self) -> Rays:
        """The same rays (n,), flattened."""
        xy = np.ascontiguousarray(self.xy.reshape(-1, 2))
        return Rays(self.uv_px.reshape(-1, 2), xy, self.cos4.reshape(-1))


def _narrow_taps(psf_sigma_px: float) -> Float32:
    side = 0.5 * psf_sigma_px**2
    return np.array([side, 1.0 - 2.0 * side, side], dtype=np.float32)


def neighbours(pixels: Int64, shape: tuple[int, int]) -> Int64:
    """Return the 3 x 3 pixels about each of some (n, 9), as places in the flattened image, rim reflected."""
    rows, columns = (
        size - 1 - np.abs(size - 1 - np.abs(place[:, np.newaxis] + np.arange(-1, 2)))
        for place, size in zip(np.divmod(pixels, shape[1]), shape, strict=True)
    )
    return np.asarray(rows[:, :, np.newaxis] * shape[1] + columns[:, np.newaxis]).reshape(len(pixels), 9)


def blur_inner(values: Float32, inner: Int64, around: Int64, psf_sigma_px: float) -> Float32:
    """Return values (n,) of some pixels, `inner` ones (k,) blurred as `blur` does below `NARROW_PX`.

    `around` (k, 9) says where their `neighbours` are among the n.
    """
    taps = _narrow_taps(psf_sigma_px)
    blurred = values.copy()
    blurred[inner] = values[around] @ np.outer(taps, taps).ravel()
    return blurred


def blur(image: Float32, psf_sigma_px: float) -> Float32:
    """Convolve an image (H, W) with the Gaussian point-spread function; the rim is reflected.

    The Gaussian is sampled at the pixel centres: its variance is psf_sigma_px^2 within 1 % from 0.65 px on.
    Below, the grid would undersample it; there three taps have its variance exactly.
    """
    if psf_sigma_px == 0.0:
        return image
    if psf_sigma_px < NARROW_PX:
        taps = _narrow_taps(psf_sigma_px)
        blurred = cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)
    else:
        radius = int(np.ceil(4.0 * psf_sigma_px))
        size = (2 * radius + 1, 2 * radius + 1)
        blurred = cv2.GaussianBlur(image, size, psf_sigma_px, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, dtype=np.float32)
