"""What a replay writes as numbers: results.csv, a row a frame, and summary.json."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from arctrack.recording.score import AxisScore, Score
from robot_io import SeamOffset
from tracker import flags
from tracker.state import NAN, Track

RESULTS_CSV, SUMMARY_JSON, BUS_LOG = "results.csv", "summary.json", "bus.blf"
OVERLAY_VIDEO, OVERVIEW_PICTURE = "overlay.mp4", "overview.png"
FILES = (RESULTS_CSV, SUMMARY_JSON, BUS_LOG, OVERLAY_VIDEO, OVERVIEW_PICTURE)
"""Every file that a replay writes."""

SUMMARY_FORMAT = "arctrack-summary/1"

COLUMNS = (
    "frame",
    "timestamp_s",
    "valid",
    "flags",
    "seam_x_mm",
    "seam_y_mm",
    "seam_z_mm",
    "sigma_y_mm",
    "sigma_z_mm",
    "offset_y_mm",
    "offset_z_mm",
    "gap_mm",
    "mismatch_mm",
    "confidence",
    "arc_level",
    "map_misfit",
    "compute_ms",
)


class ResultsWriter:
    """Writes results.csv; every row is on disk before the next frame is looked at."""

    def __init__(self, folder: Path) -> None:
        self._file = (folder / RESULTS_CSV).open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(COLUMNS)
        self._file.flush()

    def write(self, track: Track, offset: SeamOffset, compute_ms: float = NAN) -> None:
        """Append a frame's row: its track and the offset that went to the bus."""
        lengths_mm = (
            *track.seam_tool_mm,
            track.sigma_y_mm,
            track.sigma_z_mm,
            offset.offset_y_mm,
            offset.offset_z_mm,
            track.gap_mm,
            track.mismatch_mm,
        )
        self._writer.writerow(
            (
                track.frame,
                f"{track.timestamp_s:.6f}",
                int(track.valid),
                "|".join(track.flag_names),
                *(_text(value, 5) for value in lengths_mm),
                _text(track.confidence, 4),
                _text(track.arc_level, 5),
                _text(track.map_misfit, 4),
                _text(compute_ms, 3),
            )
        )
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


@dataclass(frozen=True)
class Latency:
    """Quantiles of the time from a decoded frame and its pose to the track, ms; NaN if none was timed."""

    p50: float
    p95: float
    p99: float
    max: float

    @classmethod
    def of(cls, compute_ms: Sequence[float]) -> Latency:
        """Return the quantiles of the times that are known."""
        known = [value for value in compute_ms if math.isfinite(value)]
        if not known:
            return cls(NAN, NAN, NAN, NAN)
        return cls(*(float(value) for value in np.quantile(known, [0.5, 0.95, 0.99, 1.0])))


@dataclass(frozen=True)
class Summary:
    """A whole replay in numbers.

    `offsets` counts what the gate did by verdict, `refusals` what it did not let through by reason.
    """

    recording: str
    use_arc_map: bool
    frames: int
    valid: int
    flags: Mapping[str, int]
    offsets: Mapping[str, int]
    refusals: Mapping[str, int]
    recorded_rate_hz: float
    replayed_rate_hz: float
    latency_ms: Latency
    score: Score | None

    def to_json(self) -> dict[str, Any]:
        """Return the content of summary.json; what is not known is null."""
        content: dict[str, Any] = {
            "format": SUMMARY_FORMAT,
            "recording": self.recording,
            "arc_map": self.use_arc_map,
            "frames": {
                "total": self.frames,
                "valid": self.valid,
                "invalid": self.frames - self.valid,
                "unreadable": self.flags.get(flags.FRAME_UNREADABLE.name, 0),
            },
            "flags": dict(self.flags),
            "offsets": {**self.offsets, "reasons": dict(self.refusals)},
            "rate_hz": {"recorded": self.recorded_rate_hz, "replayed": self.replayed_rate_hz},
            "latency_ms": asdict(self.latency_ms),
        }
        if self.score is not None:
            content["error_mm"] = _score_json(self.score)
        rounded: dict[str, Any] = _rounded(content)
        return rounded

    def write(self, folder: Path) -> None:
        """Write summary.json."""
        text = json.dumps(self.to_json(), indent=2, allow_nan=False)
        (folder / SUMMARY_JSON).write_text(text + "\n", encoding="utf-8")


def count_flags(tracks: Sequence[Track]) -> dict[str, int]:
    """Return how many frames carry each flag, in the registry's order, without those that none carries."""
    counts = Counter(name for track in tracks for name in track.flag_names)
    return {flag.name: counts[flag.name] for flag in flags.FLAGS if counts[flag.name]}


def _score_json(score: Score) -> dict[str, Any]:
    def axis(axis_score: AxisScore) -> dict[str, Any]:
        return {
            **asdict(axis_score.whole),
            "constant_part": axis_score.constant_mm,
            "with_constant_part_removed": asdict(axis_score.without_constant),
        }

    return {
        "frames": score.frames,
        "lateral": axis(score.lateral),
        "vertical": axis(score.vertical),
        "limit": score.limit_mm,
        "valid_frames_beyond_limit": score.beyond_limit,
    }


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, float):
        return round(value, 5) if math.isfinite(value) else None
    return value


def _text(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else ""
