"""Assignment of the stripe's pieces to the gauge's faces, and an initial pose of the gauge."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from calibration.camera.lens import Lens
from calibration.gauge.adjustment import GaugeState, Sighting
from calibration.gauge.shape import EDGE, Gauge, Shape
from calibration.gauge.stripe_pieces import Piece, Pieces
from calibration.laser.plane import foot_on, points_on_sheet
from noise_model.compiled.arrays import Float64
from noise_model.instrument.laser import Laser
from noise_model.transforms import transform

EDGE_SIGMA_MM = 0.2
"""1 sigma of where the stripe ends on a step's edge: edges are broken, and the stripe is as wide."""

MAX_SIZE_ERROR = 0.35
"""A size that is measured farther than that share off the stated one is of another thing."""


@dataclass(frozen=True)
class PosedPieces:
    """An image's pieces and the robot's pose (4, 4), mm, at which it was taken."""

    name: str
    pieces: Pieces
    T_base_tool: Float64


@dataclass(frozen=True)
class StatedSensor:
    """Camera and sheet as a setup states them: `T_tool_camera` (4, 4), mm, and the laser, tool frame.

    The sheet need only be accurate enough to identify the gauge's faces.
    """

    lens: Lens
    T_tool_camera: Float64
    laser: Laser

    def on_sheet(self, rays: Float64) -> Float64:
        """Return the points (n, 3), tool frame, mm, in which rays (n, 3) meet the sheet."""
        return points_on_sheet(self.laser, self.T_tool_camera[:3, 3], rays @ self.T_tool_camera[:3, :3].T)


def _ends_in_base(each: PosedPieces, piece: Piece, sensor: StatedSensor) -> Float64:
    """Return the ends (2, 3) of a piece, mm, base frame."""
    rays = _on_line(piece, sensor.lens, each.pieces.along_rows)
    return transform(each.T_base_tool, sensor.on_sheet(rays))


def _on_line(piece: Piece, lens: Lens, along_rows: bool) -> Float64:
    """Return the rays (2, 3) of the line's points next to the piece's ends."""
    ends = lens.rays(np.stack([piece.first, piece.last]))
    a, b = piece.line.rays
    column = 0 if along_rows else 1
    share = (ends[:, column] - a[column]) / (b[column] - a[column])
    return np.asarray(a + share[:, np.newaxis] * (b - a))


def place_gauge(
    shown: Sequence[PosedPieces], gauge: Gauge, sensor: StatedSensor, up: Float64
) -> tuple[GaugeState, list[Sighting], dict[str, str]]:
    """Assign pieces to faces and place the gauge, with the sheet as stated.

    `up` is the direction out of the gauge's top, within some degrees, base frame. Returns a start, the images
    that show the gauge, and the others with why each is left out.
    """
    left_out: dict[str, str] = {}
    kept: list[tuple[PosedPieces, int]] = []
    all_ends: list[Float64] = []
    sides: list[Float64] = []
    for each in shown:
        ends = [_ends_in_base(each, piece, sensor) for piece in each.pieces.pieces]
        reason, order = _order(gauge, ends, up)
        if reason:
            left_out[each.name] = reason
            continue
        sorted_ends = [end if order > 0 else end[::-1] for end in ends[::order]]
        across = sorted_ends[-1].mean(axis=0) - sorted_ends[0].mean(axis=0)
        if gauge.shape is Shape.V and sides and across @ sides[0] < 0.0:
            order, sorted_ends, across = -order, [end[::-1] for end in sorted_ends[::-1]], -across
        kept.append((each, order))
        all_ends.append(np.stack(sorted_ends))
        sides.append(across)
    if not kept:
        return GaugeState(sensor.laser, np.eye(4), np.zeros(3), gauge.size_mm), [], left_out
    z = _top(all_ends, gauge, up)
    edges = np.stack([_edge_of(ends, gauge) for ends in all_ends])
    y = np.mean([side / np.linalg.norm(side) for side in sides], axis=0)
    y = y - (y @ z) * z
    T = np.eye(4)
    T[:3, 1], T[:3, 2] = y / np.linalg.norm(y), z
    T[:3, 0] = np.cross(T[:3, 1], z)
    T[:3, 3] = edges.mean(axis=0)
    in_tool = [np.asarray(np.linalg.inv(each.T_base_tool), dtype=np.float64) for each, _ in kept]
    points = np.concatenate(
        [transform(T_tb, ends.reshape(-1, 3)) for T_tb, ends in zip(in_tool, all_ends, strict=True)]
    )
    centre = foot_on(sensor.laser.plane, points.mean(axis=0))
    sightings = [_sighting(each, order, gauge, sensor) for each, order in kept]
    return GaugeState(sensor.laser, T, centre, gauge.size_mm), sightings, left_out


def _order(gauge: Gauge, ends: Sequence[Float64], up: Float64) -> tuple[str, int]:
    """Return the mismatch of image and gauge, empty if none, and the pieces' order: 1 along y, else -1."""
    heights = [end @ up for end in ends]
    if gauge.shape is Shape.STEP:
        # At the step itself: a tilted gauge makes heights differ elsewhere.
        drop = float(heights[0][1] - heights[1][0])
        if not abs(abs(drop) / gauge.size_mm - 1.0) < MAX_SIZE_ERROR:
            return f"shows a step of {abs(drop):.2f} mm, the gauge's has {gauge.size_mm:g} mm", 1
        return "", 1 if drop > 0.0 else -1
    root = 0.5 * float(heights[1][1] + heights[2][0])
    depth = 0.5 * float(heights[0][1] + heights[3][0]) - root
    if not abs(depth / gauge.size_mm - 1.0) < MAX_SIZE_ERROR:
        return f"shows a V {depth:.2f} mm deep, the gauge's has {gauge.size_mm:g} mm", 1
    mouth = ends[3][0] - ends[0][1]
    slope = 0.5 * float(np.linalg.norm(mouth - (mouth @ up) * up)) / depth
    ratio = slope / math.tan(math.radians(0.5 * gauge.angle_deg))
    # A V looks wider where the stripe crosses it aslant.
    if not 0.8 < ratio < 1.6:
        angle_deg = 2.0 * math.degrees(math.atan(slope))
        return f"shows a V of some {angle_deg:.0f}° across, the gauge's has {gauge.angle_deg:g}°", 1
    return "", 1


def _edge_of(ends: Float64, gauge: Gauge) -> Float64:
    """Return the gauge's origin (3,) in an image, mm: a step's upper edge, above a V's root."""
    return np.asarray(ends[0, 1] if gauge.shape is Shape.STEP else 0.5 * (ends[0, 1] + ends[-1, 0]))


def _top(all_ends: Sequence[Float64], gauge: Gauge, up: Float64) -> Float64:
    """Return the top's normal (3,), base frame, that fits the pieces on it and is closest to `up`."""
    pieces = gauge.pieces
    flat = [n for n, face in enumerate(pieces) if face == 0 or gauge.shape is Shape.STEP]
    directions = np.array([ends[n][1] - ends[n][0] for ends in all_ends for n in flat])
    directions = directions / np.linalg.norm(directions, axis=1)[:, np.newaxis]
    # The normal is perpendicular to all of them; where they are parallel, it is as close to `up` as can be.
    M = directions.T @ directions / len(directions) + np.radians(5.0) ** 2 * (np.eye(3) - np.outer(up, up))
    z = np.linalg.eigh(M)[1][:, 0]
    return np.asarray(z * np.sign(z @ up))


def _sighting(each: PosedPieces, order: int, gauge: Gauge, sensor: StatedSensor) -> Sighting:
    pieces = each.pieces.pieces[::order]
    rays = [piece.line.rays for piece in pieces]
    across = [np.tile(piece.line.across, (2, 1)) for piece in pieces]
    blocks = [piece.line.covariance for piece in pieces]
    faces = [[face] * 2 for face in gauge.pieces]
    if gauge.shape is Shape.STEP:
        high = pieces[0]
        end = _on_line(high, sensor.lens, each.pieces.along_rows)[1 if order > 0 else 0]
        along = high.line.rays[1] - high.line.rays[0]
        along = along / np.linalg.norm(along)
        step = 1e-4
        a, b = sensor.on_sheet(np.stack([end, end + step * along]))
        mm_per_slope = float(np.linalg.norm(b - a)) / step
        # An end is known to a scan line.
        sigma = np.hypot(EDGE_SIGMA_MM / mm_per_slope, 0.5 / float(sensor.lens.values[0]))
        rays.append(end[np.newaxis])
        across.append(along[np.newaxis])
        blocks.append(np.array([[sigma**2]]))
        faces.append([EDGE])
    return Sighting(
        each.name,
        each.T_base_tool,
        np.concatenate(rays),
        np.concatenate(faces).astype(np.int64),
        np.concatenate(across),
        np.asarray(block_diag(*blocks)),
    )
