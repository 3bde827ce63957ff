"""Inputs of a live run's steps other than frames, as a recording keeps them: it replays to the same tracks.

steps.csv has a line a frame: the pose that the step had, the look-ahead of its offset, and whether the seam
began again. state.json is the tracker's state before the first frame. Numbers are written so that they are
read back the same, bit for bit.
"""

import csv
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.csv_file import number, number_or_unknown, read_csv, whole
from arctrack.recording.files import blamed_on, read_text
from tracker.arc.burning import ArcMemory
from tracker.seam.earlier_pass import EarlierPass
from tracker.seam.gaussian_process import SeamHistory
from tracker.seam.joint_ends import Change, JointEnds
from tracker.state import NAN, OffsetLookAhead, Pose
from tracker.step import StepInputs
from tracker.stripe.scatter import FrameScatter, Scatter
from tracker.tracker_state import Steering, TrackerMemory

STEPS_CSV, STATE_JSON = "steps.csv", "state.json"
FORMAT = "arctrack-tracker-state/1"

REFUSED, MEASURED, EXTRAPOLATED = 0, 1, 2
"""States of a pose in steps.csv."""

_ENTRIES = tuple(f"T_{row}{column}" for row in range(3) for column in range(4))
COLUMNS = {
    "frame": whole(LIMITS.frame_number),
    "pose": whole(EXTRAPOLATED),
    **dict.fromkeys(_ENTRIES, number_or_unknown),
    "lead_time_s": number,
    "lead_way_mm": number,
    "keeps_state": whole(1),
    "begins": whole(1),
}

RECORDS = {
    record.__name__: record
    for record in (
        TrackerMemory,
        SeamHistory,
        EarlierPass,
        Steering,
        JointEnds,
        Change,
        Scatter,
        FrameScatter,
        ArcMemory,
    )
}
"""Records of a state."""


@dataclass(frozen=True)
class RecordedStep:
    """Inputs of a step other than its frame and the state; see `StepInputs`.

    `begins` says that the seam began again before it.
    """

    pose: Pose | None
    look_ahead: OffsetLookAhead
    keeps_state: bool
    begins: bool


@dataclass(frozen=True)
class RecordedSteps:
    """The steps of a live run, by frame number, and the tracker's state before the first of them."""

    state: TrackerMemory
    steps: Mapping[int, RecordedStep]


def write_steps(folder: Path, inputs: Iterable[tuple[int, StepInputs]]) -> None:
    """Write steps.csv and state.json of steps in order, each with its frame's number."""
    with (folder / STEPS_CSV).open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for n, (frame, step) in enumerate(inputs):
            if n == 0:
                write_state(folder / STATE_JSON, step.state)
            table.writerow((frame, *_cells(step, n > 0 and step.state.frames == 0)))


def read_steps(folder: Path) -> RecordedSteps | None:
    """Read steps.csv and state.json; None where there are none. ArctrackError names the file and the line."""
    path = folder / STEPS_CSV
    if not path.exists():
        return None
    table = read_csv(path, COLUMNS)
    steps: dict[int, RecordedStep] = {}
    for line, (frame, pose, *entries, time_s, way_mm, keeps_state, begins) in zip(
        table.lines.tolist(), table.values.tolist(), strict=True
    ):
        if pose != REFUSED and not np.isfinite(entries).all():
            raise in_file(path, "a pose that is not refused has twelve numbers", line=line)
        steps[int(frame)] = RecordedStep(
            None if pose == REFUSED else Pose(_matrix(entries), pose == EXTRAPOLATED),
            OffsetLookAhead(time_s, way_mm),
            bool(keeps_state),
            bool(begins),
        )
    return RecordedSteps(read_state(folder / STATE_JSON), steps)


def write_state(path: Path, state: TrackerMemory) -> None:
    """Write a tracker's state."""
    document = {"format": FORMAT, "state": _encoded(state)}
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")


def read_state(path: Path) -> TrackerMemory:
    """Read a tracker's state; ArctrackError says what is wrong with the file."""
    with blamed_on(path, "there is no such file; steps.csv needs it"):
        text = read_text(path, LIMITS.toml_bytes)
    try:
        document = json.loads(text)
        if document["format"] != FORMAT:
            raise ValueError(f"is of the format {document['format']!r}, not {FORMAT!r}")
        state = _decoded(document["state"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise in_file(path, f"holds no tracker's state: {error}") from None
    if not isinstance(state, TrackerMemory):
        raise in_file(path, "holds no tracker's state")
    return state


def _cells(step: StepInputs, begins: bool) -> tuple[Any, ...]:
    pose = step.pose
    entries = [NAN] * len(_ENTRIES) if pose is None else pose.T_base_tool[:3].ravel().tolist()
    kind = REFUSED if pose is None else EXTRAPOLATED if pose.extrapolated else MEASURED
    # repr comes back the same.
    numbers = ["" if math.isnan(entry) else repr(float(entry)) for entry in entries]
    look_ahead = (repr(float(step.lead.time_s)), repr(float(step.lead.way_mm)))
    return kind, *numbers, *look_ahead, int(step.keeps_state), int(begins)


def _matrix(entries: list[float]) -> Any:
    return np.vstack([np.reshape(entries, (3, 4)), (0.0, 0.0, 0.0, 1.0)])


def _encoded(value: Any) -> Any:
    """Return a value as JSON has it; a record and an array say what they are."""
    if isinstance(value, np.ndarray):
        values = value.ravel().tolist()
        return {"array": values, "shape": list(value.shape), "dtype": value.dtype.str}
    if hasattr(value, "_fields"):
        return {
            "record": type(value).__name__,
            **{name: _encoded(getattr(value, name)) for name in value._fields},
        }
    if isinstance(value, tuple):
        return [_encoded(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_decoded(item) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return np.array(value["array"], np.dtype(value["dtype"])).reshape(value["shape"])
    record = RECORDS[value["record"]]
    return record(**{name: _decoded(item) for name, item in value.items() if name != "record"})
