"""The seam's process on a line that turns: a part that lies displaced is displaced alike everywhere in base.

On a straight line a whole seam's displacement is one number across and one in height. Where the line turns,
the part's displacement is a vector w of base. Each station shows w along its own left and up, so a place
behind a corner shows what no place before it does:
d(s) = A(s) w + b(s), A(s) = (left, up), w ~ N(0, s_0^2 I), b the bend of `gaussian_process`, one across and
one in height. On a straight line this is that process.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import SeamSegments
from noise_model.transforms import invert, transform
from tracker.seam.gaussian_process import (
    BEND_LENGTH_MM,
    BEND_SIGMA_MM,
    MIN_VARIANCE_MM2,
    SLOPE_SIGMA,
    WIDE_SIGMA_MM,
    SeamHistory,
    SeamPrediction,
)

DECAY = math.sqrt(3.0) / BEND_LENGTH_MM
TURN_OVER_MM = 2.0
"""Longest way before and behind a point of the line over which it turns there; a short piece's half is less.

An arc is stated by its chords, and turns all along them. A chord of 4 mm is off a circle of 50 mm by 0.04 mm.
"""

EDGE_MM, PLATE_MM = 3.0, 8.0
"""Width on either side of the seam over which an edge is read, at least, and one where two plates meet.

A plate that rises beside a seam that turns is no plane: a pipe's wall.
"""


class TurningLine(NamedTuple):
    """Directions of a nominal line: left and up (k, 2, 3), base frame, at stations (k,), rising."""

    stations_mm: Float64
    axes_base: Float64

    @classmethod
    def of(cls, segments: SeamSegments) -> TurningLine:
        """Return a line's: constant along its pieces, but for where they meet."""
        axes = segments.frames[:, :3, 1:3].transpose(0, 2, 1)
        lengths_mm = np.linalg.norm(segments.steps, axis=1)
        start_mm = float(transform(invert(segments.frames[0]), segments.starts[0])[0])
        meets_mm = start_mm + np.cumsum(lengths_mm)[:-1]
        half_mm = np.minimum(0.5 * np.minimum(lengths_mm[:-1], lengths_mm[1:]), TURN_OVER_MM)
        stations_mm = np.column_stack([meets_mm - half_mm, meets_mm + half_mm]).ravel()
        around = np.stack([axes[:-1], axes[1:]], axis=1).reshape(-1, 2, 3)
        return cls(np.array([start_mm, *stations_mm]), np.concatenate([axes[:1], around]))

    def at(self, stations_mm: Float64) -> Float64:
        """Return left and up (n, 2, 3), base frame, at stations (n,)."""
        axes = self.axes_base.reshape(-1, 6).T
        turned = np.array([np.interp(stations_mm, self.stations_mm, axis) for axis in axes])
        return turned.T.reshape(-1, 2, 3)

    def sagitta_mm(self, station_mm: float, aside_mm: float, crossing: float) -> float:
        """Return how far the line leaves its tangent where a sheet shows the joint, mm.

        The joint reaches `aside_mm` to either side; the sheet cuts the seam at a cosine of `crossing`.
        """
        way_mm = aside_mm * math.sqrt(max(1.0 - crossing**2, 0.0)) / crossing
        before, behind = self.at(np.array([station_mm - way_mm, station_mm + way_mm]))
        return 0.25 * way_mm * float(np.linalg.norm(behind - before, axis=1).max())


def condition_turning(history: SeamHistory, line: TurningLine, station_mm: float) -> SeamPrediction:
    """Return the seam at a station of a line that turns, as a history's measurements leave it."""
    x, n = history.stations_mm, history.n
    # Across first, then in height.
    seen = line.at(x).transpose(1, 0, 2).reshape(2 * n, 3)
    before, here, behind = line.at(station_mm + TURN_OVER_MM * np.array([-1.0, 0.0, 1.0]))
    turn = (behind - before) / (2.0 * TURN_OVER_MM)
    whole_mm2, bend_mm2 = WIDE_SIGMA_MM**2, BEND_SIGMA_MM**2
    ahead = DECAY * (x - station_mm)
    fade = bend_mm2 * np.exp(-np.abs(ahead))
    bend, bend_slope = (1.0 + np.abs(ahead)) * fade, DECAY * ahead * fade
    none = np.zeros(n)
    of_bends = np.array([[*bend, *none], [*none, *bend], [*bend_slope, *none], [*none, *bend_slope]])
    across = of_bends + whole_mm2 * np.concatenate([here, turn]) @ seen.T
    apart = DECAY * np.abs(x[:, None] - x)
    K = whole_mm2 * seen @ seen.T
    K[:n, :n] += bend_mm2 * (1.0 + apart) * np.exp(-apart)
    K[n:, n:] += bend_mm2 * (1.0 + apart) * np.exp(-apart)
    K[np.diag_indices(2 * n)] += history.variances_mm2.T.ravel()
    factor = cho_factor(K, check_finite=False)
    mean = across @ cho_solve(factor, history.displacements_mm.T.ravel(), check_finite=False)
    # Between two pieces' directions a mean is shorter than 1.
    prior = whole_mm2 * np.sum(here**2, axis=1) + bend_mm2
    variance = np.array([*prior, *2 * (DECAY**2 * bend_mm2,)])
    cross = np.concatenate([across[:2], of_bends[2:]])
    variance -= np.sum(cross.T * cho_solve(factor, cross.T, check_finite=False), axis=0)
    y_mm, z_mm, slope_y, slope_z = mean.tolist()
    sigma_y, sigma_z = np.sqrt(np.maximum(variance[:2], 0.0)).tolist()
    information = 1.0 / np.maximum(variance[2:], MIN_VARIANCE_MM2) - 1.0 / (DECAY**2 * bend_mm2)
    sure_y, sure_z = (1.0 / np.sqrt(1.0 / SLOPE_SIGMA**2 + np.maximum(information, 0.0))).tolist()
    first_mm, last_mm = (float(x.min()), float(x.max())) if n else (math.nan, math.nan)
    return SeamPrediction(
        (y_mm, z_mm), (sigma_y, sigma_z), (slope_y, slope_z), (sure_y, sure_z), first_mm, last_mm
    )
