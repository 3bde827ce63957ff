"""Numeric results of a replay: results.csv, a row a frame, and summary.json."""

import csv
import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from arctrack.offset_count import OffsetCount
from arctrack.output import write_whole, writing
from arctrack.recording.run_offsets import NO_OUTCOME, OffsetOutcome, RunComparison
from arctrack.recording.score import AxisScore, TrackScore
from tracker import flags
from tracker.state import NAN, Track

RESULTS_CSV, SUMMARY_JSON, BUS_LOG = "results.csv", "summary.json", "bus.blf"
OVERLAY_VIDEO, OVERVIEW_PICTURE, REPLAY_PAGE = "overlay.mp4", "overview.png", "replay.html"
REPLAY_MCAP, REPLAY_RRD = "replay.mcap", "replay.rrd"
FINISHED_JSON = "finished.json"
FILES = (
    FINISHED_JSON,
    RESULTS_CSV,
    SUMMARY_JSON,
    BUS_LOG,
    OVERLAY_VIDEO,
    OVERVIEW_PICTURE,
    REPLAY_PAGE,
    REPLAY_MCAP,
    REPLAY_RRD,
)
"""Every file that a replay may write."""

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
    "fov_margin_mm",
    "gap_sigma_mm",
    "mismatch_sigma_mm",
    "bevel_left_deg",
    "bevel_left_sigma_deg",
    "bevel_right_deg",
    "bevel_right_sigma_deg",
    "plate_left_deg",
    "plate_left_sigma_deg",
    "plate_right_deg",
    "plate_right_sigma_deg",
    "area_mm2",
    "area_sigma_mm2",
    "arc_level_sigma",
    "arc_height_mm",
    "arc_height_sigma_mm",
    "arc_height_unknown",
    "pose_doubt",
    "validity",
    "gate_reason",
    "run_offset_y_mm",
    "run_offset_z_mm",
    "run_validity",
    "run_gate_reason",
    "run_pose_doubt",
    "weld_speed_mm_s",
    "weld_weave_mm",
    "weld_wire_m_min",
    "weld_refusal",
)
"""The format's own columns, then arctrack's."""


class ArcAboveSurface(NamedTuple):
    """Height of the arc's centre above the surface, mm, and its 1 sigma; NaN where `unknown` says why."""

    height_mm: float = NAN
    sigma_mm: float = NAN
    unknown: str = ""


NO_ARC_HEIGHT = ArcAboveSurface(unknown="not_estimated")


class ResultsWriter:
    """Writer of results.csv; every row is on disk before the next frame is processed.

    Raises ArctrackError if the file cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / RESULTS_CSV
        with writing(self._path):
            self._file = self._path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._append(COLUMNS)

    def write(
        self,
        track: Track,
        outcome: OffsetOutcome,
        compute_ms: float = NAN,
        run: OffsetOutcome | None = None,
        arc: ArcAboveSurface = NO_ARC_HEIGHT,
    ) -> None:
        """Append a frame's row: track, its offset on the bus, and in a replay what the run had sent."""
        run = run or NO_OUTCOME
        lengths_mm = (
            *track.seam_tool_mm,
            track.sigma_y_mm,
            track.sigma_z_mm,
            outcome.offset_y_mm,
            outcome.offset_z_mm,
            track.gap_mm,
            track.mismatch_mm,
        )
        self._append(
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
                *(_text(value, 5) for value in _section_values(track)),
                _text(track.arc_level_sigma, 5),
                *(_text(value, 4) for value in arc[:2]),
                arc.unknown,
                outcome.pose_doubt,
                outcome.validity,
                outcome.gate_reason,
                _text(run.offset_y_mm, 5),
                _text(run.offset_z_mm, 5),
                run.validity,
                run.gate_reason,
                run.pose_doubt,
                *(_text(value, 4) for value in outcome.weld[:3]),
                outcome.weld.refusal,
            )
        )

    def _append(self, row: Sequence[object]) -> None:
        with writing(self._path):
            try:
                self._writer.writerow(row)
                self._file.flush()
            except OSError:
                # What did not fit would fail again at the end.
                with suppress(OSError):
                    self._file.close()
                raise

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
    def of(cls, compute_ms: Sequence[float]) -> "Latency":
        """Return the quantiles of the times that are known."""
        known = [value for value in compute_ms if math.isfinite(value)]
        if not known:
            return cls(NAN, NAN, NAN, NAN)
        return cls(*(float(value) for value in np.quantile(known, [0.5, 0.95, 0.99, 1.0])))


@dataclass(frozen=True)
class Summary:
    """A whole replay in numbers.

    `offsets` counts what the gate did by verdict, `refusals` what it did not let through by reason.
    `joint_ends_mm` is station and 1 sigma of the joint's start and end, where they were found. `pose_doubts`
    counts the frames at which poses were not trusted, by doubt; `heard_robot_status` says whether a
    RobotStatus was recorded, without which fewer doubts can arise. `run_offsets` compares the offsets of a
    black box with those that its run sent; None for other recordings. `laser_on` counts the frames with the
    laser on.
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
    score: TrackScore | None
    joint_ends_mm: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pose_doubts: Mapping[str, int] = field(default_factory=dict)
    heard_robot_status: bool = False
    run_offsets: RunComparison | None = None
    laser_on: int = 0

    @property
    def offset_count(self) -> OffsetCount:
        """The offsets sent, of those that the robot wanted."""
        return OffsetCount.of(self.offsets.get("send", 0), sum(self.offsets.values()), self.refusals)

    @property
    def counts(self) -> str:
        """The offsets sent and the valid frames, each of how many, in words."""
        return counts_in_words(self.offset_count, self.valid, self.laser_on)

    def __str__(self) -> str:
        error = ""
        if self.score is not None:
            lateral, vertical = self.score.lateral.whole.rms, self.score.vertical.whole.rms
            error = f", RMS error {lateral:.3f} mm lateral and {vertical:.3f} mm vertical"
        return f"{self.recording}: {self.counts}{error}"

    def to_json(self) -> dict[str, Any]:
        """Return the content of summary.json; what is not known is null."""
        content: dict[str, Any] = {
            "format": "arctrack-summary/1",
            "recording": self.recording,
            "arc_map": self.use_arc_map,
            "frames": {
                "total": self.frames,
                "laser_on": self.laser_on,
                "valid": self.valid,
                "invalid": self.frames - self.valid,
                "unreadable": self.flags.get(flags.FRAME_UNREADABLE.name, 0),
            },
            "flags": dict(self.flags),
            "offsets": {**self.offsets, "wanted": self.offset_count.wanted, "reasons": dict(self.refusals)},
            "poses": {"robot_status": self.heard_robot_status, "doubts": dict(self.pose_doubts)},
            "rate_hz": {"recorded": self.recorded_rate_hz, "replayed": self.replayed_rate_hz},
            "latency_ms": asdict(self.latency_ms),
        }
        if self.joint_ends_mm:
            content["joint_ends"] = {
                end: {"station_mm": station_mm, "sigma_mm": sigma_mm}
                for end, (station_mm, sigma_mm) in self.joint_ends_mm.items()
            }
        if self.run_offsets is not None:
            content["run_offsets"] = self.run_offsets.to_json()
        if self.score is not None:
            content["error_mm"] = _score_json(self.score)
        rounded: dict[str, Any] = _rounded(content)
        return rounded

    def write(self, folder: Path) -> None:
        """Write summary.json; ArctrackError if it cannot be written."""
        text = json.dumps(self.to_json(), indent=2, allow_nan=False)
        write_whole(folder / SUMMARY_JSON, text + "\n")


def _section_values(track: Track) -> Iterator[float]:
    """Return a row's own columns of what the section shows."""
    shape = track.shape
    yield from (track.fov_margin_mm, shape.gap_sigma_mm, shape.mismatch_sigma_mm)
    for angles_deg, sigmas_deg in (
        (shape.bevel_angles_deg, shape.bevel_sigmas_deg),
        (shape.plate_angles_deg, shape.plate_sigmas_deg),
    ):
        for angle_deg, sigma_deg in zip(angles_deg, sigmas_deg, strict=True):
            yield from (angle_deg, sigma_deg)
    yield from (shape.area_mm2, shape.area_sigma_mm2)


def count_flags(tracks: Sequence[Track]) -> dict[str, int]:
    """Return the number of frames with each flag, in the registry's order; flags of no frame are left out."""
    counts = Counter(name for track in tracks for name in track.flag_names)
    return {flag.name: counts[flag.name] for flag in flags.FLAGS if counts[flag.name]}


def counts_in_words(offsets: OffsetCount, valid: int, laser_on: int) -> str:
    """Return a run's result: offsets sent and valid frames, each with the number that there could be."""
    return f"{offsets}; {valid} of {laser_on} frames with the laser on are valid"


def _score_json(score: TrackScore) -> dict[str, Any]:
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
