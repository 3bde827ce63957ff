"""The measured section, and triangulation: from the stripe's lines to points of the joint frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median
from noise_model.compiled.ordering import stable_order
from noise_model.instrument.camera import Intrinsics, distorted, undistorted
from noise_model.instrument.laser import Sheet, plane_met, sheet_in
from noise_model.surface.faces import ridge
from noise_model.transforms import inverted
from tracker.geometry import StripeSource
from tracker.seam.locate import meet_ridges
from tracker.state import (
    AMPLITUDE_E,
    BESIDE_PX,
    BIAS_PX,
    CENTRE_PX,
    DY_MM,
    DZ_MM,
    MISFIT_PX,
    N_LINES,
    N_ROWS,
    SCAN,
    SIGMA_PX,
    WIDTH_PX,
    Y_MM,
    Z_MM,
    Stripe,
)
from tracker.stripe.edge import clear_lines
from tracker.stripe.light import NO_LIGHT, EdgeLines, StripeLight

MIN_POINTS = 20
"""A section of fewer points shows no joint."""

STEP_LINES, MIN_HELD = 4, 2
"""The means of so many lines on either side tell a step; of so many at least that hold a stripe."""

STEP_SIGMAS = 3.0
"""By so many sigmas of their scatter both means must differ: one line in 400 does so by chance."""

MIN_CONTRAST = 0.02
"""Change of a stripe's brightness from line to line without speckle."""

_NOWHERE, _NO_POINTS = np.full(3, math.nan), np.empty((N_ROWS, 0))


class Section(NamedTuple):
    """The measured cross-section in the joint frame.

    `points` (N_ROWS, n) are in order of y, by the rows of `state`; `column_mm` is the spacing of scan lines
    in y. The seam is looked for within `reach_mm` of y = 0; nearer to a corner than `mixed_mm` a scan line
    holds light of both faces. `slope_sigma` is that of the seam's direction. `light` is what the stripe was
    read from, `NO_LIGHT` where it is not at hand; `camera_mm` and `laser_mm` (3,) are from where it was seen
    and lit, joint frame, NaN where that is not known. `off_trace` (N_ROWS, m) are a profile's points that its
    trace leaves out, most of them false echoes; `n_columns` it has, 0 for an image.
    """

    points: Float64
    column_mm: float
    reach_mm: float = math.inf
    mixed_mm: float = 0.0
    slope_sigma: float = 0.0
    light: StripeLight = NO_LIGHT
    camera_mm: Float64 = _NOWHERE
    laser_mm: Float64 = _NOWHERE
    off_trace: Float64 = _NO_POINTS
    n_columns: int = 0

    @property
    def all_points(self) -> Float64:
        """The points and those off the trace (N_ROWS, n + m), in order of y."""
        if self.off_trace.shape[1] == 0:
            return self.points
        points = np.hstack([self.points, self.off_trace])
        return np.take(points, np.argsort(points[Y_MM], kind="stable"), axis=1)

    @property
    def y_mm(self) -> Float64:
        """The points' y (n,), mm."""
        return np.asarray(self.points[Y_MM])

    @property
    def z_mm(self) -> Float64:
        """The points' height (n,), mm."""
        return np.asarray(self.points[Z_MM])

    @property
    def scan(self) -> Float64:
        """The points' scan lines (n,)."""
        return np.asarray(self.points[SCAN])

    @property
    def sigma_px(self) -> Float64:
        """The stripe centres' 1 sigma (n,), px."""
        return np.asarray(self.points[SIGMA_PX])


def points_of(
    y_mm: Float64,
    z_mm: Float64,
    *,
    scan: Float64,
    sigma_px: Float64,
    beside_px: Float64,
    dy_mm: Float64 | float = 0.0,
    dz_mm: Float64 | float = 0.0,
) -> Float64:
    """Return points (N_ROWS, n) of a line each, whose centres were not corrected."""
    points = np.zeros((N_ROWS, len(y_mm)))
    points[Y_MM], points[Z_MM], points[DY_MM], points[DZ_MM] = y_mm, z_mm, dy_mm, dz_mm
    points[SCAN], points[SIGMA_PX], points[BESIDE_PX], points[N_LINES] = scan, sigma_px, beside_px, 1.0
    return points


@kernel(allocates=True)
def in_scan_order(points: Float64) -> Float64:
    """Return points (N_ROWS, n) in order of their scan lines, the way in which y rises on the whole.

    Beside an edge, where a line holds light of two faces, it may lie at any y.
    """
    scan = points[SCAN]
    n, rising, falling = scan.shape[0], 0, 0
    for i in range(1, n):
        rising += scan[i] > scan[i - 1]
        falling += scan[i] < scan[i - 1]
    if rising == 0 or falling == 0:
        return points
    order = stable_order(scan if scan[n - 1] > scan[0] else -scan)
    ordered = np.empty((N_ROWS, n))
    for row in range(N_ROWS):
        for i in range(n):
            ordered[row, i] = points[row, order[i]]
    return ordered


def lines_of(stripe: Stripe, bias_px: Float64) -> Float64:
    """Return the scan lines (N_ROWS, n_scan) of a stripe of which no more is known."""
    n_scan = len(stripe.position_px)
    lines = np.full((N_ROWS, n_scan), math.nan)
    lines[CENTRE_PX], lines[SCAN], lines[BIAS_PX] = stripe.position_px, np.arange(n_scan), bias_px
    lines[SIGMA_PX], lines[BESIDE_PX] = stripe.sigma_px, stripe.beside_px
    lines[MISFIT_PX], lines[N_LINES] = 0.0, 1.0
    return lines


class EdgeAlongSeam(NamedTuple):
    """Geometry of the edges that cross the stripe.

    They lie `height_mm` over the surface, and their direction is known to `slope_sigma`; the brightness of
    scan lines scatters by `contrast`.
    """

    height_mm: float
    slope_sigma: float
    contrast: float


_NO_EDGE = EdgeAlongSeam(0.0, 0.0, 1.0)


class Points(NamedTuple):
    """Points (N_ROWS, n) and their scan lines' spacing, mm; how an edge crosses them.

    Nearer to a corner than `mixed_lines` a scan line holds light of both faces.
    """

    points: Float64
    column_mm: float
    edge: EdgeLines
    mixed_lines: int


def triangulate(source: StripeSource, scene: Scene, lines: Float64, edge: EdgeAlongSeam = _NO_EDGE) -> Points:
    """Return the points of a stripe's scan lines (N_ROWS, n_scan), NaN where there is none.

    Centres are corrected for their bias, and unsure by steps of brightness that cross them. `scene` should
    run along the seam as it is expected, for a section seen skewed is another section.
    """
    measured: Points = _triangulate(
        lines=lines,
        edge=edge,
        lens=source.lens,
        along_rows=source.along_rows,
        psf_sigma_px=source.psf_sigma_px,
        sheet_tool=source.sheet,
        T_joint_tool=scene.T_joint_tool,
        T_joint_camera=scene.T_joint_camera,
        corrugation=scene.shape.corrugation,
    )
    return measured


@kernel(allocates=True)
def edge_lines(
    lens: Intrinsics,
    along_rows: bool,
    T_joint_camera: Float64,
    sheet_joint: Sheet,
    edge: EdgeAlongSeam,
    corrugation: Float64,
) -> EdgeLines:
    """Return over how many scan lines the sheet spreads an edge along the seam.

    Seen from off its plane, a sheet as thick as it is meets the edge in one line before its middle and in
    another behind. So it does where the seam runs skewed. Over ridges the edge rises by their slope c': with
    planes next to the sheet, n.p + d = +-sigma, it meets sigma / (n_x + n_z c') before and behind.
    """
    nx, _, nz, d = plane_met(sheet_joint, (0.0, 0.0, edge.height_mm), (1.0, 0.0, 0.0))
    of_valley, T = -(nz * edge.height_mm + d) / nx, inverted(T_joint_camera)
    x = meet_ridges(of_valley, of_valley, nz / nx, corrugation)
    height, slope = ridge(x, corrugation)
    along, z = sheet_joint.sigma / (nx + nz * slope), edge.height_mm + height
    aside = edge.slope_sigma * along
    seen = np.empty((3, 2))
    for k in range(3):
        x_k = x + (k - 1) * along
        z_k = edge.height_mm + ridge(x_k, corrugation)[0]
        seen[k] = _line_of(lens, along_rows, T, x_k, 0.0, z_k)
    turned = _line_of(lens, along_rows, T, x, aside, z)[0] - _line_of(lens, along_rows, T, x, -aside, z)[0]
    before, behind = seen[0] - seen[1], seen[2] - seen[1]
    # The parabola through three places: nowhere bent where the edge runs along a scan line.
    px = behind[1] - before[1]
    if not px * before[1] < 0.0 < px * behind[1]:
        return EdgeLines(0.0, 0.0, 0.5 * abs(behind[0] - before[0]), 0.5 * abs(turned))
    bend = (behind[0] / behind[1] - before[0] / before[1]) / px
    skew = behind[0] / behind[1] - bend * behind[1]
    return EdgeLines(skew, bend, 0.5 * abs(behind[0] - before[0]), 0.5 * abs(turned))


@kernel
def _line_of(
    lens: Intrinsics, along_rows: bool, T_camera_joint: Float64, x: float, y: float, z: float
) -> tuple[float, float]:
    """Return the scan line, and the position in it, of a point of the joint frame, mm."""
    T = T_camera_joint
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    a = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth
    b = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth
    X, Y, _, _, _, _ = distorted(a, b, lens)
    u, v = lens.fx * X + lens.cx, lens.fy * Y + lens.cy
    return (u, v) if along_rows else (v, u)


@kernel(allocates=True)
def _triangulate(
    lines: Float64,
    edge: EdgeAlongSeam,
    lens: Intrinsics,
    along_rows: bool,
    psf_sigma_px: float,
    sheet_tool: Sheet,
    T_joint_tool: Float64,
    T_joint_camera: Float64,
    corrugation: Float64,
) -> Points:
    """Return the points of scan lines in order of y.

    The camera's ray d from o meets the sheet, there n.p + e = 0, in o + t d, t = -(n.o + e) / n.d. With a
    change of the ray by d' that point moves by t (d' - d (n.d') / (n.d)).
    """
    sheet = sheet_in(T_joint_tool, sheet_tool)
    crossed = edge_lines(lens, along_rows, T_joint_camera, sheet, edge, corrugation)
    possible = math.hypot(crossed.stated, crossed.turned)
    skewed_px = skewed_sigma_px(lines[AMPLITUDE_E], lines[WIDTH_PX], edge.contrast, possible)
    position_px, bias_px, n_lines = lines[CENTRE_PX], lines[BIAS_PX], lines[N_LINES]
    points, n = np.empty((N_ROWS, lines.shape[1])), 0
    R = T_joint_camera
    eye = R[0, 3], R[1, 3], R[2, 3]
    for s in range(len(position_px)):
        if math.isnan(position_px[s]) or (n_lines[s] > 1.0 and s % 2 == 1):
            continue
        line, position, beside_px = float(s), position_px[s] - bias_px[s], lines[BESIDE_PX, s]
        if n_lines[s] > 1.0:
            line, position = line + 0.5, 0.5 * (position + (position_px[s + 1] - bias_px[s + 1]))
            # Of two lines' mean that is a half, but no less than it has alone.
            beside_px = max(math.sqrt(0.5) * beside_px, lines[SIGMA_PX, s])
        u, v = (line, position) if along_rows else (position, line)
        x, y, x_u, x_v, y_u, y_v = undistorted(u, v, lens)
        x_r, y_r = (x_v, y_v) if along_rows else (x_u, y_u)
        d_x, d_y = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
        d_z = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        c_x, c_y = R[0, 0] * x_r + R[0, 1] * y_r, R[1, 0] * x_r + R[1, 1] * y_r
        c_z = R[2, 0] * x_r + R[2, 1] * y_r
        nx, ny, nz, e = plane_met(sheet, eye, (d_x, d_y, d_z))
        off, towards = nx * eye[0] + ny * eye[1] + nz * eye[2] + e, nx * d_x + ny * d_y + nz * d_z
        # A ray that runs away from the plane meets it nowhere.
        t = -off / towards if towards != 0.0 else -1.0
        if not t > 0.0:
            continue
        turned = (nx * c_x + ny * c_y + nz * c_z) / towards
        height, slope = ridge(R[0, 3] + t * d_x, corrugation)
        points[Y_MM, n], points[Z_MM, n] = R[1, 3] + t * d_y, R[2, 3] + t * d_z - height
        points[DY_MM, n] = t * (c_y - d_y * turned)
        points[DZ_MM, n] = t * (c_z - d_z * turned) - slope * t * (c_x - d_x * turned)
        points[SCAN, n], points[BIAS_PX, n] = line, bias_px[s]
        points[SIGMA_PX, n] = math.hypot(lines[SIGMA_PX, s], skewed_px[s])
        points[BESIDE_PX, n] = math.hypot(beside_px, skewed_px[s])
        points[MISFIT_PX, n], points[N_LINES, n] = lines[MISFIT_PX, s], n_lines[s]
        n += 1
    order, kept = stable_order(points[Y_MM, :n]), np.empty((N_ROWS, n))
    for row in range(N_ROWS):
        for i in range(n):
            kept[row, i] = points[row, order[i]]
    return Points(kept, _spacing(kept), crossed, clear_lines(psf_sigma_px, crossed.stated) - 1)


@kernel
def _neighbours(ln_amplitude: Float64, s: int, away: int) -> tuple[float, float, int]:
    """Return the mean of lines (n,) next to line s, the nearest one's value, and how many hold a stripe."""
    total, nearest, count = 0.0, math.nan, 0
    for k in range(1, STEP_LINES + 1):
        line = s + away * k
        if 0 <= line < ln_amplitude.shape[0] and not math.isnan(ln_amplitude[line]):
            total += ln_amplitude[line]
            if count == 0:
                nearest = ln_amplitude[line]
            count += 1
    return (total / count if count > 0 else math.nan), nearest, count


@kernel(allocates=True)
def skewed_sigma_px(amplitude_e: Float64, width_px: Float64, contrast: float, lines: float) -> Float64:
    """Return the 1 sigma, px, by which a step of brightness that crosses the stripe moves each centre (n,).

    At a groove's foot, where one face shines and the next hardly does, the brightness steps within a few
    lines, along the seam. Where the seam runs skewed through the image, a line next to the step holds more of
    the bright side's light on one flank. A bell of 1 sigma w times exp(b t), t the place across it, is the
    same bell b w^2 farther. With A(s) the brightness of the lines s and a step that moves by `lines` over
    the bell's sigma, b = lines / w d(ln A)/ds, so a centre is off by w lines d(ln A)/ds.

    `lines` is known as well as the seam's direction is, so this is an uncertainty and no correction. What
    speckle explains counts for nothing: `contrast` is that of the lines' brightness. `amplitude_e` and
    `width_px` (n,), e- and px, are NaN for lines without a stripe.
    """
    n, scatter = amplitude_e.shape[0], max(contrast, MIN_CONTRAST)
    ln_amplitude, sigma_px = np.empty(n), np.zeros(n)
    for s in range(n):
        ln_amplitude[s] = math.log(amplitude_e[s]) if amplitude_e[s] > 0.0 else math.nan
    for s in range(n):
        before, last, n_before = _neighbours(ln_amplitude, s, -1)
        behind, first, n_behind = _neighbours(ln_amplitude, s, 1)
        if min(n_before, n_behind) < MIN_HELD or math.isnan(width_px[s]):
            continue
        variance = scatter * scatter * (1.0 / n_before + 1.0 / n_behind)
        if (behind - before) ** 2 > STEP_SIGMAS**2 * variance:
            sigma_px[s] = width_px[s] * lines * 0.5 * abs(first - last)
    return sigma_px


@kernel(allocates=True)
def _spacing(points: Float64) -> float:
    """Return the median spacing of neighbouring scan lines in y, mm, NaN of fewer than two.

    A place between two lines stands for both.
    """
    y_mm, scan = points[Y_MM], points[SCAN]
    apart = np.empty(max(len(y_mm) - 1, 0))
    for i in range(len(apart)):
        apart[i] = (y_mm[i + 1] - y_mm[i]) / (1.0 + scan[i] % 1.0 + scan[i + 1] % 1.0)
    return exact_median(apart)
