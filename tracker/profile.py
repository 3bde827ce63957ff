"""Triangulation: the stripe's points in the tool frame and beside the joint, with what each can move by."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.arrays import Float64, Int64, Integers
from noise_model.instrument.camera import Intrinsics, distorted, undistorted
from noise_model.instrument.laser import plane_in
from noise_model.kernel import kernel
from noise_model.median import exact_median, median
from noise_model.surface.faces import ridge
from noise_model.transforms import inverted
from tracker.geometry import SensorGeometry, StripeSource
from tracker.stripe.askew import askew_sigma_px
from tracker.stripe.edge import clear_lines
from tracker.stripe.light import StripeLight

MIN_POINTS = 20
"""A profile of fewer points shows no joint."""


@dataclass(frozen=True)
class Profile:
    """The measured cross-section in the joint frame, in order of y; n points.

    `y_mm`, `z_mm` (n,): the points, a corrugation's height taken off z; `dy_mm`, `dz_mm` (n,): how a point
    moves when its stripe centre moves by 1 px; `sigma_px` (n,): that centre's 1 sigma, `beside_px` (n,)
    that with which it counts among neighbours that are off alike. `column_mm` is the
    points' spacing in y, `scan` (n,) the scan lines they came from. The seam is looked for within
    `reach_mm` of y = 0. `light` is what the stripe was read from, `image_dn` (n_scan, n_pos) the whole
    frame by scan line, None where they are not at hand. Nearer to a corner than `mixed_mm` a scan line holds
    light of both faces. `bias_px` (n,) is by how much the centres were corrected for light that is no bell,
    None if they were not. `misfit_px` (n,) is by how much centres may be off, alike with their neighbours',
    for light beneath the stripe that is not as expected, None for not at all. `slope_sigma` is how well the
    seam's direction is known. `n_lines` (n,) is how many scan lines each point stands for, None for 1: two
    that were read as one are a point between them.
    """

    y_mm: Float64
    z_mm: Float64
    dy_mm: Float64
    dz_mm: Float64
    sigma_px: Float64
    scan: Float64
    column_mm: float
    beside_px: Float64
    reach_mm: float = math.inf
    light: StripeLight | None = None
    image_dn: Integers | None = None
    mixed_mm: float = 0.0
    bias_px: Float64 | None = None
    misfit_px: Float64 | None = None
    slope_sigma: float = 0.0
    n_lines: Float64 | None = None

    @property
    def lines_each(self) -> Float64:
        """How many scan lines each point (n,) stands for."""
        return np.ones(len(self.y_mm)) if self.n_lines is None else self.n_lines

    def by_scan(self) -> Profile:
        """Return the profile in order of its scan lines, the way in which y rises on the whole.

        Beside an edge, where a line holds light of two faces, it may lie at any y.
        """
        if is_in_order(self.scan):
            return self
        order = scan_order(self.scan)
        points = (self.y_mm, self.z_mm, self.dy_mm, self.dz_mm, self.sigma_px, self.scan, self.beside_px)
        y, z, dy, dz, sigma, scan, beside = (values[order] for values in points)
        bias = None if self.bias_px is None else self.bias_px[order]
        misfit = None if self.misfit_px is None else self.misfit_px[order]
        n_lines = None if self.n_lines is None else self.n_lines[order]
        return replace(
            self,
            y_mm=y,
            z_mm=z,
            dy_mm=dy,
            dz_mm=dz,
            sigma_px=sigma,
            scan=scan,
            beside_px=beside,
            bias_px=bias,
            misfit_px=misfit,
            n_lines=n_lines,
        )


@kernel(allocates=True)
def scan_order(scan: Float64) -> Int64:
    """Return the points' order by their scan lines (n,), the way in which these run on the whole."""
    rises = scan.shape[0] < 2 or scan[-1] > scan[0]
    return np.argsort(scan if rises else -scan, kind="mergesort")


@kernel
def is_in_order(values: Float64) -> bool:
    """Say whether values (n,) only rise or only fall."""
    rising, falling = 0, 0
    for i in range(1, values.shape[0]):
        rising += values[i] > values[i - 1]
        falling += values[i] < values[i - 1]
    return rising == 0 or falling == 0


def triangulate(
    geometry: SensorGeometry,
    scene: Scene,
    position_px: Float64,
    sigma_px: Float64,
    beside_px: Float64,
) -> Profile:
    """Return the profile of a stripe given per scan line (n_scan,), NaN where there is none.

    The camera's ray through the stripe's centre meets the laser plane in the point; how the point moves with
    the centre is all its first-order covariance. `scene` should run along the seam as it is expected, for a
    section seen askew is another section.
    """
    n_scan = len(position_px)
    points, scan = np.empty((5, n_scan)), np.empty(n_scan)
    n, column, is_in_order = _triangulate(
        position_px=position_px,
        sigma_px=sigma_px,
        n_lines=np.ones(n_scan, np.int64),
        lens=geometry.setup.camera.intrinsics,
        along_rows=geometry.along_rows,
        T_joint_camera=scene.T_joint_camera,
        T_joint_tool=scene.T_joint_tool,
        plane_in_tool=geometry.setup.laser.plane,
        corrugation=scene.shape.corrugation,
        points=points,
        scan=scan,
    )
    y, z, dy, dz, sigma = points[:, :n]
    scan = scan[:n]
    if not is_in_order:
        order = np.argsort(y, kind="stable")
        # Rows that lie strided in memory are another type to the kernels, which they would compile for anew.
        y, z, dy, dz, sigma = np.take(points, order, axis=1)
        scan, column = scan[order], median(np.diff(y))
    return Profile(
        y_mm=y,
        z_mm=z,
        dy_mm=dy,
        dz_mm=dz,
        sigma_px=sigma,
        scan=scan,
        column_mm=column,
        beside_px=beside_px[scan.astype(np.int64)],
    )


class EdgeLines(NamedTuple):
    """Over how many scan lines an edge along the seam crosses the sheet's 1 sigma.

    `stated` as the seam is expected to run, `possible` with how well its direction is known.
    """

    stated: float
    possible: float


@kernel(allocates=True)
def edge_lines(source: StripeSource, scene: Scene, z_mm: float, slope_sigma: float) -> EdgeLines:
    """Return over how many scan lines the sheet's 1 sigma spreads an edge along the seam, at a height.

    Seen from beside its plane, a sheet as thick as it is meets the edge in one line before its middle and in
    another behind. So it does where the seam runs askew: its slope is known to `slope_sigma`.
    """
    nx, _, nz, d = plane_in(scene.T_joint_tool, source.sheet.plane)
    x, along = -(nz * z_mm + d) / nx, source.sheet.sigma / nx
    aside = slope_sigma * along
    T_camera_joint = inverted(scene.T_joint_camera)
    stated = _line_of(source, T_camera_joint, x + along, 0.0, z_mm)
    stated = 0.5 * abs(stated - _line_of(source, T_camera_joint, x - along, 0.0, z_mm))
    turned = _line_of(source, T_camera_joint, x, aside, z_mm)
    turned = 0.5 * abs(turned - _line_of(source, T_camera_joint, x, -aside, z_mm))
    return EdgeLines(stated, math.hypot(stated, turned))


@kernel
def _line_of(source: StripeSource, T_camera_joint: Float64, x: float, y: float, z: float) -> float:
    """Return the scan line that a point of the joint frame, mm, is seen in."""
    T, lens = T_camera_joint, source.lens
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    a = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth
    b = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth
    X, Y, _, _, _, _ = distorted(a, b, lens)
    return lens.fx * X + lens.cx if source.along_rows else lens.fy * Y + lens.cy


class StripeLines(NamedTuple):
    """What a profile is made of, by scan line (n_scan,); see `state.Stripe`, for bias and misfit `Profile`.

    `width_px` is the fitted 1 sigma across the stripe. Where `n_lines` is 2, an even line and the next were
    read as one.
    """

    position_px: Float64
    sigma_px: Float64
    beside_px: Float64
    amplitude_e: Float64
    width_px: Float64
    bias_px: Float64
    misfit_px: Float64
    n_lines: Int64


class Points(NamedTuple):
    """A profile's points (n,) in order of y; see `Profile`, for `sheet_lines` `edge.StripeLight`."""

    y_mm: Float64
    z_mm: Float64
    dy_mm: Float64
    dz_mm: Float64
    sigma_px: Float64
    scan: Float64
    column_mm: float
    beside_px: Float64
    bias_px: Float64
    misfit_px: Float64
    n_lines: Float64
    sheet_lines: float
    mixed_mm: float


@kernel(allocates=True)
def measured_points(
    source: StripeSource,
    scene: Scene,
    lines: StripeLines,
    contrast: float,
    edge_mm: float,
    slope_sigma: float,
) -> Points:
    """Triangulate a stripe: its centres are corrected for their bias, and unsure by steps that cross it.

    `contrast` is that of the lines' brightness. Edges along the seam are `edge_mm` over the surface, and its
    slope is known to `slope_sigma`.
    """
    n_scan = lines.position_px.shape[0]
    rows, scan = np.empty((9, n_scan)), np.empty(n_scan)
    lines_over = edge_lines(source, scene, edge_mm, slope_sigma)
    askew_px = askew_sigma_px(lines.amplitude_e, lines.width_px, contrast, lines_over.possible)
    centre_px, sigma_px = np.empty(n_scan), np.empty(n_scan)
    for s in range(n_scan):
        centre_px[s] = lines.position_px[s] - lines.bias_px[s]
        sigma_px[s] = math.hypot(lines.sigma_px[s], askew_px[s])
    n, column_mm, is_in_order = _triangulate(
        position_px=centre_px,
        sigma_px=sigma_px,
        n_lines=lines.n_lines,
        lens=source.lens,
        along_rows=source.along_rows,
        T_joint_camera=scene.T_joint_camera,
        T_joint_tool=scene.T_joint_tool,
        plane_in_tool=source.sheet.plane,
        corrugation=scene.shape.corrugation,
        points=rows,
        scan=scan,
    )
    if not is_in_order:
        order = np.argsort(rows[0, :n], kind="mergesort")
        kept, kept_scan = rows[:5, :n].copy(), scan[:n].copy()
        for i in range(n):
            scan[i] = kept_scan[order[i]]
            for row in range(5):
                rows[row, i] = kept[row, order[i]]
        column_mm = _spacing(rows[0, :n], scan[:n])
    for i in range(n):
        s = int(scan[i])
        n_lines = lines.n_lines[s]
        beside_px = lines.beside_px[s]
        if n_lines > 1:
            # Of two lines' mean that is a half, but no less than it has alone.
            beside_px = max(math.sqrt(0.5) * beside_px, lines.sigma_px[s])
        rows[5, i] = math.hypot(beside_px, askew_px[s])
        rows[6, i], rows[7, i], rows[8, i] = lines.bias_px[s], lines.misfit_px[s], n_lines
    return Points(
        y_mm=rows[0, :n],
        z_mm=rows[1, :n],
        dy_mm=rows[2, :n],
        dz_mm=rows[3, :n],
        sigma_px=rows[4, :n],
        scan=scan[:n],
        column_mm=column_mm,
        beside_px=rows[5, :n],
        bias_px=rows[6, :n],
        misfit_px=rows[7, :n],
        n_lines=rows[8, :n],
        sheet_lines=lines_over.stated,
        mixed_mm=column_mm * (clear_lines(source.psf_sigma_px, lines_over.stated) - 1),
    )


@kernel(allocates=True)
def _spacing(y: Float64, scan: Float64) -> float:
    """Return the median spacing of neighbouring lines' places (n,), NaN of fewer than two.

    A place between two lines stands for both.
    """
    apart = np.empty(max(len(y) - 1, 0))
    for i in range(len(apart)):
        apart[i] = (y[i + 1] - y[i]) / (1.0 + scan[i] % 1.0 + scan[i + 1] % 1.0)
    return exact_median(apart)


@kernel(allocates=True)
def _triangulate(
    position_px: Float64,
    sigma_px: Float64,
    n_lines: Int64,
    lens: Intrinsics,
    along_rows: bool,
    T_joint_camera: Float64,
    T_joint_tool: Float64,
    plane_in_tool: Float64,
    corrugation: Float64,
    points: Float64,
    scan: Float64,
) -> tuple[int, float, bool]:
    """Write y, z, dy, dz and sigma (5, n) of the scan lines that hold a point, and those.

    Returns how many they are, the median spacing of lines and whether their y rises. Two lines that were read
    as one make one point between them.

    A ray d from o meets the plane n.p + e = 0 in o + t d, t = -(n.o + e) / n.d. With a change of the ray by
    d' that point moves by t (d' - d (n.d') / (n.d)).
    """
    R = T_joint_camera
    nx, ny, nz, e = plane_in(T_joint_tool, plane_in_tool)
    off = nx * R[0, 3] + ny * R[1, 3] + nz * R[2, 3] + e
    n = 0
    for s in range(len(position_px)):
        if math.isnan(position_px[s]) or (n_lines[s] > 1 and s % 2 == 1):
            continue
        line, position = float(s), position_px[s]
        if n_lines[s] > 1:
            line, position = line + 0.5, 0.5 * (position + position_px[s + 1])
        u, v = (line, position) if along_rows else (position, line)
        x, y, x_u, x_v, y_u, y_v = undistorted(u, v, lens)
        x_r, y_r = (x_v, y_v) if along_rows else (x_u, y_u)
        d_x, d_y = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
        d_z = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        c_x, c_y = R[0, 0] * x_r + R[0, 1] * y_r, R[1, 0] * x_r + R[1, 1] * y_r
        c_z = R[2, 0] * x_r + R[2, 1] * y_r
        towards = nx * d_x + ny * d_y + nz * d_z
        # A ray that runs away from the plane meets it nowhere.
        t = -off / towards if towards != 0.0 else -1.0
        if not t > 0.0:
            continue
        turned = (nx * c_x + ny * c_y + nz * c_z) / towards
        height, slope = ridge(R[0, 3] + t * d_x, corrugation)
        points[0, n], points[1, n] = R[1, 3] + t * d_y, R[2, 3] + t * d_z - height
        points[2, n] = t * (c_y - d_y * turned)
        points[3, n] = t * (c_z - d_z * turned) - slope * t * (c_x - d_x * turned)
        points[4, n], scan[n] = sigma_px[s], line
        n += 1
    # In order of y if the image shows it from the other side.
    flips = n > 1 and points[0, 0] > points[0, n - 1]
    for i in range(n // 2 if flips else 0):
        j = n - 1 - i
        scan[i], scan[j] = scan[j], scan[i]
        for row in range(5):
            points[row, i], points[row, j] = points[row, j], points[row, i]
    is_in_order = True
    for i in range(1, n):
        is_in_order &= points[0, i] >= points[0, i - 1]
    return n, _spacing(points[0, :n], scan[:n]), is_in_order
