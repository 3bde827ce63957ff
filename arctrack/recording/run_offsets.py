"""Comparison of the offsets that a live run sent, by its black box, with those of a replay."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from arctrack.errors import in_file
from arctrack.recording.weld_schedule import NO_WELD, WeldValues
from tracker.state import NAN

LIVE_FOLDER, LIVE_RESULTS = "live", "results.csv"


@dataclass(frozen=True)
class OffsetOutcome:
    """Outcome of a frame's offset: y and z, mm, its validity, the gate's reason, the doubt of the poses.

    The texts are those of results.csv; `gate_reason` and `pose_doubt` are empty where there was none, and all
    three where they were not recorded. `weld` is what the weld schedule gives for the torch's place.
    """

    offset_y_mm: float = NAN
    offset_z_mm: float = NAN
    validity: str = ""
    gate_reason: str = ""
    pose_doubt: str = ""
    weld: WeldValues = NO_WELD

    @property
    def gate(self) -> str:
        """Decision of the gate, with the reason."""
        return ", ".join(text for text in (self.validity, self.gate_reason) if text) or "not noted"

    def differs(self, other: "OffsetOutcome") -> bool:
        """Return True if another offset is a different one for a robot."""
        pairs = (self.offset_y_mm, other.offset_y_mm), (self.offset_z_mm, other.offset_z_mm)
        is_other = any(not _is_same(run_mm, other_mm) for run_mm, other_mm in pairs)
        return is_other or (bool(self.validity) and self.validity != other.validity)


NO_OUTCOME = OffsetOutcome()
"""Nothing is known of it."""


@dataclass
class RunComparison:
    """Count of frames whose offset a replay would send otherwise than the run did.

    `frames` are those that both have; `differences` counts by the decision of the run's gate, then by that of
    the replay's.
    """

    frames: int = 0
    differences: dict[str, dict[str, int]] = field(default_factory=dict)

    def add(self, run: OffsetOutcome, replayed: OffsetOutcome) -> None:
        """Take a frame."""
        self.frames += 1
        if run.differs(replayed):
            by_replay = self.differences.setdefault(run.gate, {})
            by_replay[replayed.gate] = by_replay.get(replayed.gate, 0) + 1

    def _most_common(self) -> list[tuple[str, str, int]]:
        """Return the outcomes of both gates with their number of frames, the most frequent first."""
        kinds = [
            (run, here, n) for run, by_replay in self.differences.items() for here, n in by_replay.items()
        ]
        return sorted(kinds, key=lambda kind: -kind[2])

    def __str__(self) -> str:
        different = self._most_common()
        count = sum(n for _, _, n in different)
        if count == 0:
            return f"all {self.frames} offsets are those that the run sent"
        kinds = [f"{n} in the run {run}, here {here}" for run, here, n in different[:3]]
        others = len(different) - len(kinds)
        kinds += [f"{others} more kinds"] if others > 0 else []
        return (
            f"{count} of {self.frames} offsets are not those that the run sent: {'; '.join(kinds)}. "
            "A replay takes a robot that tracks and welds from the first frame on, without delays; "
            "run_… in results.csv is what the run sent"
        )

    def to_json(self) -> dict[str, object]:
        """Return the content for summary.json."""
        different = self._most_common()
        return {
            "frames": self.frames,
            "differ": sum(n for _, _, n in different),
            "differences": [{"run": run, "replay": here, "frames": n} for run, here, n in different],
        }


def read_run_offsets(recording: Path) -> Mapping[int, OffsetOutcome]:
    """Return the offsets that a live run sent, by frame; none for a recording that is no black box.

    Raises ArctrackError, with the cure, where the file is there and cannot be read.
    """
    path = recording / LIVE_FOLDER / LIVE_RESULTS
    if not path.is_file():
        return {}
    outcomes = {}
    n_rows = 0
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                n_rows += 1
                outcomes[int(row["frame"])] = OffsetOutcome(
                    float(row["offset_y_mm"] or NAN),
                    float(row["offset_z_mm"] or NAN),
                    row.get("validity") or "",
                    row.get("gate_reason") or "",
                    row.get("pose_doubt") or "",
                )
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise in_file(
            path, f"row {n_rows}: {error!r}; take {LIVE_FOLDER}/{LIVE_RESULTS} away to replay without it"
        ) from None
    return outcomes


def _is_same(run_mm: float, other_mm: float) -> bool:
    if math.isnan(run_mm) or math.isnan(other_mm):
        return math.isnan(run_mm) and math.isnan(other_mm)
    # The resolution of an offset on the bus, mm: closer ones are the same.
    return abs(run_mm - other_mm) < 0.001
