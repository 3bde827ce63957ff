"""Errors of a replay's seam points against truth.csv."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arctrack.recording.tables import Truth
from noise_model.compiled.arrays import Float64
from tracker.state import Track


@dataclass(frozen=True)
class ErrorSizes:
    """Sizes of errors, mm: RMS, and median, 95 % quantile and maximum of the absolute value."""

    rms: float
    median: float
    p95: float
    max: float


@dataclass(frozen=True)
class AxisScore:
    """The errors of one axis, mm: as they are, their constant part, and with that part removed."""

    whole: ErrorSizes
    constant_mm: float
    without_constant: ErrorSizes


@dataclass(frozen=True)
class TrackScore:
    """The errors of all valid frames that truth.csv knows, in the tool frame.

    `beyond_limit` counts the frames whose lateral or vertical error exceeds `limit_mm` though they are valid.
    """

    frames: int
    lateral: AxisScore
    vertical: AxisScore
    limit_mm: float
    beyond_limit: int


def score(tracks: Sequence[Track], truth: Truth, limit_mm: float) -> TrackScore | None:
    """Return the errors of the valid tracks, None if truth.csv knows none of them."""
    errors = errors_mm(tracks, truth)
    known = errors[np.isfinite(errors).all(axis=1)]
    if not len(known):
        return None
    return TrackScore(
        frames=len(known),
        lateral=_axis(known[:, 0]),
        vertical=_axis(known[:, 1]),
        limit_mm=limit_mm,
        beyond_limit=int((np.abs(known) > limit_mm).any(axis=1).sum()),
    )


def errors_mm(tracks: Sequence[Track], truth: Truth) -> Float64:
    """Return measured minus true (n, 2), lateral and vertical, NaN where invalid or without truth."""
    true_points = dict(zip(truth.frames.tolist(), truth.seam_tool_mm, strict=True))
    errors = np.full((len(tracks), 2), np.nan)
    for n, track in enumerate(tracks):
        true_point = true_points.get(track.frame)
        if track.valid and true_point is not None:
            errors[n] = np.subtract(track.seam_tool_mm, true_point)[1:]
    return errors


def _axis(errors: Float64) -> AxisScore:
    constant = float(errors.mean())
    return AxisScore(_spread(errors), constant, _spread(errors - constant))


def _spread(errors: Float64) -> ErrorSizes:
    size = np.abs(errors)
    return ErrorSizes(
        rms=float(np.sqrt(np.mean(errors**2))),
        median=float(np.median(size)),
        p95=float(np.quantile(size, 0.95)),
        max=float(size.max()),
    )
