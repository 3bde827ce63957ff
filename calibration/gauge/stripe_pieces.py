"""The stripe on a gauge in an image: its path, and the straight pieces that it is made of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from calibration.camera.lens import Lens
from calibration.laser.image_line import LaserLineFit, fit_line
from calibration.laser.stripe import LaserLight, likeliest_path
from noise_model.compiled.arrays import Float64, Integers
from noise_model.robust import spread

NOISE_FLOOR_DN = 0.5
"""Rounding leaves that much noise at least."""

MIN_PIECE_SHARE = 0.06
"""A piece has that share of the path at least."""

TRIM_SCALES, MIN_TRIM_PX = 2.0, 2.0
"""Length left out at a corner, in the stripe's sigmas and px: it is round there, and blurred."""

MIN_LINES = 12
"""Least number of scan lines of a piece."""


@dataclass(frozen=True)
class Piece:
    """A straight piece of the stripe.

    `points_px` (n, 2) are its points, `line` is fitted to their rays; `first` and `last` (2,) are its ends
    before corners were left out, px.
    """

    points_px: Float64
    line: LaserLineFit
    first: Float64
    last: Float64


@dataclass(frozen=True)
class Pieces:
    """Straight pieces of the stripe on a gauge, in the order of the scan lines; `scale_px` is its sigma."""

    pieces: tuple[Piece, ...]
    along_rows: bool
    scale_px: float


def laser_light_alone(image_dn: Integers) -> LaserLight:
    """Return the laser's light in an image (H, W) without another of the same scene without it."""
    image = image_dn.astype(np.float32)
    # The mean over a wide box is what lies behind the stripe.
    light = image - cv2.blur(image, (41, 41), borderType=cv2.BORDER_REFLECT)
    noise = np.full(image.shape, max(spread(light), NOISE_FLOOR_DN), np.float32)
    return LaserLight(image - float(np.median(image)), noise, np.ones(image.shape, dtype=bool))


def stripe_pieces(image_dn: Integers, lens: Lens, count: int) -> Pieces | str:
    """Return the `count` straight pieces of the stripe in an image (H, W), or what is missing, in words.

    The image is of the laser alone or with even light.
    """
    path = likeliest_path(laser_light_alone(image_dn))
    if path is None or len(path.points_px) < count * MIN_LINES:
        return "shows no stripe"
    column = 0 if path.along_rows else 1
    scan, place = path.points_px[:, column], path.points_px[:, 1 - column]
    cuts = _cuts(scan, place, count)
    trim = max(TRIM_SCALES * path.scale_px, MIN_TRIM_PX)
    pieces = []
    for low, high in zip([0, *cuts], [*cuts, len(scan)], strict=True):
        points = path.points_px[low:high]
        inner = points[(points[:, column] >= scan[low] + trim) & (points[:, column] <= scan[high - 1] - trim)]
        if len(inner) < MIN_LINES:
            return f"shows a stripe of fewer than {count} pieces"
        line = fit_line(lens.rays(inner), path.along_rows)
        pieces.append(Piece(inner[line.kept], line, points[0], points[-1]))
    return Pieces(_with_corners(pieces, path.points_px, lens, column), path.along_rows, path.scale_px)


def _with_corners(pieces: Sequence[Piece], path_px: Float64, lens: Lens, column: int) -> tuple[Piece, ...]:
    """Return the pieces with ends where the path goes over from one line to the next, to a scan line."""
    rays = lens.rays(path_px)
    off = np.stack([np.square(_off_line_along_scan(piece.line, rays, column)) for piece in pieces])
    ends = [0]
    for n, pair in enumerate(pairwise(pieces)):
        low, high = (np.searchsorted(path_px[:, column], _middle(piece, column)) for piece in pair)
        cost = np.concatenate([[0.0], np.cumsum(off[n, low:high] - off[n + 1, low:high])])
        ends.append(int(low + np.argmin(cost)))
    ends.append(len(path_px))
    return tuple(
        replace(piece, first=path_px[low], last=path_px[high - 1])
        for piece, (low, high) in zip(pieces, pairwise(ends), strict=True)
    )


def _middle(piece: Piece, column: int) -> float:
    return float(np.median(piece.points_px[:, column]))


def _off_line_along_scan(line: LaserLineFit, rays: Float64, column: int) -> Float64:
    """Return the distance of rays (n, 3) from a line, along the scan lines (n,)."""
    a, b = line.rays
    share = (rays[:, column] - a[column]) / (b[column] - a[column])
    return np.asarray(rays[:, 1 - column] - a[1 - column] - share * (b - a)[1 - column])


def _cuts(scan: Float64, place: Float64, count: int) -> Sequence[int]:
    """Return the cuts of the path into pieces that are best fitted by a line each."""
    # Pieces begin and end with one of 120 groups.
    groups = np.array_split(np.arange(len(scan)), min(120, len(scan)))
    t = np.array([np.median(scan[group]) for group in groups])
    y = np.array([np.median(place[group]) for group in groups])
    n, min_groups = len(t), max(2, int(MIN_PIECE_SHARE * len(t)))
    cost = np.full((n + 1, n + 1), np.inf)
    for low in range(n - min_groups + 1):
        for high in range(low + min_groups, n + 1):
            cost[low, high] = _line_misfit(t[low:high], y[low:high])
    best, back = cost[0].copy(), []
    for _ in range(count - 1):
        total = best[:, np.newaxis] + cost
        back.append(np.argmin(total, axis=0))
        best = total.min(axis=0)
    cuts, end = [], n
    for choice in reversed(back):
        end = int(choice[end])
        cuts.append(int(groups[end][0]) if end < n else len(scan))
    return cuts[::-1]


def _line_misfit(t: Float64, y: Float64) -> float:
    """Return the sum of squares about the line of some points."""
    t, y = t - t.mean(), y - y.mean()
    slope = float(t @ y) / max(float(t @ t), 1e-12)
    return float(np.sum((y - slope * t) ** 2))
