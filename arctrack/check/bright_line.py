"""The bright line in a frame, found without any model of where it should be."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.laser.matched_scales import SCALES_PX, smoothed_by_scale
from noise_model.compiled.arrays import Float32, Float64, Int64, Integers
from noise_model.instrument.sensor import Sensor, linearise, variance_e2
from tracker.stripe.viterbi import JUMP_COST, best_path

RIM_SIGMAS = 2.0
"""So near to the image's rim no line is looked for."""

BACKGROUND_REL = 0.05
"""Share of the surrounding light that may look like a line."""


@dataclass(frozen=True, eq=False)
class BrightLine:
    """A line: its `positions_px` (n,) in the `scan` lines (n,) that hold it, columns if it runs along rows.

    `share` is in how many of the scan lines it was found, `height_e` how far it stands over its surroundings
    there in the median, `scale_px` which sigma shows it best.
    """

    scan: Int64
    positions_px: Float64
    along_rows: bool
    share: float
    height_e: float
    scale_px: float

    @property
    def points_px(self) -> Float64:
        """Its image points (n, 2), x y."""
        pair = [self.scan, self.positions_px] if self.along_rows else [self.positions_px, self.scan]
        return np.column_stack(pair)


def no_line(along_rows: bool) -> BrightLine:
    """Return a line that was not found."""
    return BrightLine(np.empty(0, dtype=np.int64), np.empty(0), along_rows, 0.0, 0.0, SCALES_PX[0])


def find_lines(images_dn: Iterable[Integers], sensor: Sensor) -> list[BrightLine]:
    """Find the line in each image (H, W), DN: along its rows or its columns, the same for all."""
    code_e = linearise(np.arange(sensor.max_dn + 1), sensor).astype(np.float32)
    dark_e2 = float(variance_e2(0.0, sensor))
    both = [
        [_line_along(code_e[np.minimum(image, sensor.max_dn)], along, dark_e2) for along in (True, False)]
        for image in images_dn
    ]
    # What an arc lights up may be a clearer line, but hardly; without an arc the stripe is.
    rows, columns = ([pair[n] for pair in both] for n in (0, 1))
    return rows if _clearness(rows) >= _clearness(columns) else columns


def _clearness(lines: Sequence[BrightLine]) -> float:
    """Return how clear lines are, by the product of the light, e- a scan line, that makes each a line."""
    return sum(math.log(line.share * line.height_e + 1.0) for line in lines)


def _line_along(charge: Float32, along_rows: bool, dark_e2: float) -> BrightLine:
    """Return the likeliest line along an image's rows, or its columns, of the sigma that shows most."""
    scan_lines = np.ascontiguousarray(charge.T if along_rows else charge)
    best = None
    for sigma_px, near, wide in smoothed_by_scale(scan_lines):
        # A Gaussian over two axes leaves 1 / (4 pi sigma_x sigma_y) of the variance.
        noise = (np.maximum(wide, 0.0) + dark_e2) / (4.0 * np.pi * sigma_px) + (BACKGROUND_REL * wide) ** 2
        score = ((near - wide) / np.sqrt(noise)).astype(np.float32)
        # Light that rises to the image's rim, where it is mirrored, looks like a line there.
        rim = round(RIM_SIGMAS * sigma_px)
        score[:, :rim], score[:, -rim:] = 0.0, 0.0
        shows = float(score.max(axis=1).mean())
        if best is None or shows > best[0]:
            best = shows, sigma_px, score, near - wide
    if best is None:
        return no_line(along_rows)
    _, sigma_px, score, height = best
    choice = np.empty(len(score), dtype=np.int64)
    best_path(score, JUMP_COST, choice)
    lines = np.flatnonzero(choice >= 0)
    if not len(lines):
        return no_line(along_rows)
    positions = _peaks(score, lines, choice[lines], round(2.0 * sigma_px) + 1)
    share, height_e = len(lines) / len(score), float(np.median(height[lines, choice[lines]]))
    return BrightLine(lines, positions, along_rows, share, height_e, sigma_px)


def _peaks(score: Float32, lines: Int64, choice: Int64, reach: int) -> Float64:
    """Return where along lines (n,) of an image the score peaks within a reach of a choice (n,), px."""
    n_pos = score.shape[1]
    near = np.clip(choice[:, np.newaxis] + np.arange(-reach, reach + 1), 0, n_pos - 1)
    peak = near[np.arange(len(lines)), np.argmax(score[lines[:, np.newaxis], near], axis=1)]
    inner = np.clip(peak, 1, n_pos - 2)
    before, here, after = (score[lines, inner + step].astype(np.float64) for step in (-1, 0, 1))
    curve = 2.0 * here - before - after
    with np.errstate(divide="ignore", invalid="ignore"):
        between = np.where(curve > 0.0, 0.5 * (after - before) / curve, 0.0)
    return np.asarray(inner + np.clip(between, -1.0, 1.0))
