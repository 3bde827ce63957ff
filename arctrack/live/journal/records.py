"""Records of a live run: an entry for each frame, a view of the newest one, and the run's status.

Their bytes, by MessagePack, are decoded only to the classes that records are made of, so reading them runs no
code of whoever wrote them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from typing import Any, get_args, get_type_hints

import msgpack
import numpy as np

from arctrack.recording.run_offsets import NO_OUTCOME, OffsetOutcome
from noise_model.compiled.arrays import UInt8
from noise_model.surface.joint import SeamLine
from robot_io import (
    Fault,
    GateReason,
    LaserState,
    PoseSample,
    RobotStatus,
    SeamOffset,
    Source,
    TrackerCommand,
)
from robot_io import TrackerState as ServiceState
from tracker.arc.level import ArcLevel
from tracker.joint.measured import MeasuredJoint
from tracker.state import NAN, Frame, Track
from tracker.step import StepInputs

ARRAY = 0
"""The key that marks an array; a class is marked by its place in `Packer.classes`, from 1 on."""


class Packer:
    """Binary codec of records whose classes follow from their fields' annotations.

    `roots` are the outermost records' classes: dataclasses or named tuples.
    """

    def __init__(self, roots: Sequence[type]) -> None:
        self.classes: list[type] = []
        for root in roots:
            self._add(root)
        self._keys = {record: key for key, record in enumerate(self.classes, ARRAY + 1)}
        self._names = {record: names for record in self.classes if (names := _field_names(record))}

    def pack(self, record: object) -> bytes:
        """Return a record as bytes; ValueError if a part of it is of no known class."""
        packed: bytes = msgpack.packb(record, default=self._encoded, strict_types=True)
        return packed

    def unpack(self, packed: UInt8) -> Any:
        """Return the record that `pack` made bytes of."""
        return msgpack.unpackb(packed.data, object_hook=self._decoded, use_list=False, strict_map_key=False)

    def _add(self, annotation: Any) -> None:
        """Add the classes that an annotation names, and those of their fields."""
        for argument in get_args(annotation):
            self._add(argument)
        if not isinstance(annotation, type) or annotation in self.classes:
            return
        if issubclass(annotation, Enum):
            self.classes.append(annotation)
        elif names := _field_names(annotation):
            self.classes.append(annotation)
            hints = get_type_hints(annotation)
            for name in names:
                self._add(hints[name])

    def _encoded(self, value: Any) -> Any:
        """Return the substitute of a value that MessagePack lacks: a map from its mark to its parts."""
        kind = type(value)
        if kind is tuple:
            return list(value)
        if kind is np.ndarray:
            return {ARRAY: [value.dtype.str, list(value.shape), value.tobytes()]}
        names = self._names.get(kind)
        if names is not None:
            return {self._keys[kind]: [getattr(value, name) for name in names]}
        if kind in self._keys:
            return {self._keys[kind]: value.value}
        if isinstance(value, np.generic):
            return value.item()
        raise ValueError(f"no record holds a {kind.__name__}")

    def _decoded(self, value: dict[Any, Any]) -> Any:
        if len(value) != 1:
            return value
        ((key, content),) = value.items()
        if not isinstance(key, int):
            return value
        if key == ARRAY:
            dtype, shape, held = content
            return np.frombuffer(bytearray(held), np.dtype(dtype)).reshape(shape)
        record = self.classes[key - ARRAY - 1]
        return record(content) if issubclass(record, Enum) else record(*content)


def _field_names(record: type) -> tuple[str, ...]:
    """Return the names of a record's fields, in the order in which its class takes them."""
    if is_dataclass(record):
        return tuple(field.name for field in fields(record))
    return getattr(record, "_fields", ())


EIGHTH = 8
"""Alignment of a record's parts, bytes."""

NO_IMAGE = np.empty((0, 0), np.uint8)

BUCKETS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 60.0)
"""Upper ends of Prometheus' bins of times. The gate lets out what is 0.2 s old."""


@dataclass(frozen=True)
class ReceivedPose:
    """A pose of the robot, its time on the frames' clock, and when it was read, s."""

    sample: PoseSample
    read_s: float


@dataclass(frozen=True)
class Entry:
    """A tracked frame: `frame` and `inputs` as the step took them, `track` without stripe and checks.

    `poses` arrived since the entry before. `arrived_s` and `sent_s` are when the loop had the frame and sent
    its offset, NaN where it sent none; `dropped` counts frames since the start. `outcome` is what results.csv
    says of the offset.
    """

    frame: Frame
    inputs: StepInputs
    track: Track
    offset: SeamOffset
    job_number: int
    poses: tuple[ReceivedPose, ...] = ()
    arrived_s: float = NAN
    sent_s: float = NAN
    took_ms: float = NAN
    dropped: int = 0
    outcome: OffsetOutcome = NO_OUTCOME


@dataclass(frozen=True)
class FrameView:
    """Intermediate results of a frame, for display; `position` is that of its entry, counted from the first.

    The seam was expected at `seam`, within `reach_mm`; `track` has its stripe. Parts that were not computed
    are None.
    """

    position: int
    track: Track
    seam: SeamLine | None = None
    reach_mm: float = NAN
    arc: ArcLevel | None = None
    joint: MeasuredJoint | None = None


@dataclass(frozen=True)
class ProcessState:
    """State of one of the run's subprocesses.

    `pid` is that of the one that runs, or ended last. `ends` counts the times it ended by itself and was
    restarted. `problem` is empty where there is none.
    """

    pid: int
    is_running: bool
    ends: int
    problem: str


@dataclass(frozen=True)
class Status:
    """State of the run.

    `now_s` is on the frames' clock, `wall_s` the time of day, `frame_s` the newest frame's time (NaN before
    the first). `fault` holds until RESET. `offset` is the newest one sent and `reason` why it was not sent as
    measured (NONE if it was); `robot` and `command` are the latest received. `offsets` counts sent offsets by
    validity, `reasons` why they differ from the measured ones, `faults` the bus faults.

    `capture_*` times run from mid-exposure, `arrival_*` times from the frame's arrival, until the offset was
    sent. `*_ms` are median, 99 % and maximum; `*_counts` are cumulative by `BUCKETS_S`, with the total last.
    `processor_wait` is the share of the time in which the loop wants a processor that it waits for one; NaN
    if unknown.
    """

    now_s: float
    wall_s: float
    source: Source
    state: ServiceState
    fault: Fault
    laser: LaserState
    reason: GateReason
    offset: SeamOffset | None
    robot: RobotStatus | None
    command: TrackerCommand | None
    job_number: int
    frames: int
    valid: int
    dropped: int
    offsets: Mapping[str, int] = field(default_factory=dict)
    reasons: Mapping[str, int] = field(default_factory=dict)
    faults: Mapping[str, int] = field(default_factory=dict)
    capture_ms: tuple[float, float, float] = (NAN, NAN, NAN)
    arrival_ms: tuple[float, float, float] = (NAN, NAN, NAN)
    frame_s: float = NAN
    processor_wait: float = NAN
    capture_counts: tuple[int, ...] = ()
    arrival_counts: tuple[int, ...] = ()
    capture_sum_s: float = 0.0
    arrival_sum_s: float = 0.0
    processes: Mapping[str, ProcessState] = field(default_factory=dict)


@dataclass(frozen=True)
class GapReport:
    """Verdict on whether the setup explains the latest frames, and the arc's height in them.

    `time_s` is the time of the newest frame used. `is_gap` says that the arc map no longer explains the
    frames, since `since_wall_s` (time of day, NaN without a gap); `text` says what that looks like.
    `arc_height_mm` is the height of the arc's centre above the surface, NaN if unknown.
    """

    time_s: float
    is_gap: bool
    text: str = ""
    since_wall_s: float = NAN
    arc_height_mm: float = NAN
    arc_height_sigma_mm: float = NAN


_PACKER = Packer((Entry, FrameView, Status, GapReport))


def pack(record: object) -> bytes:
    """Return a record as bytes; ValueError if a part of it is of no known class."""
    return _PACKER.pack(record)


def unpack(packed: UInt8) -> Any:
    """Return what `pack` made bytes of."""
    return _PACKER.unpack(packed)


def pack_entry(entry: Entry) -> tuple[bytes, bytes, UInt8]:
    """Return an entry as parts of a record: how long the second is, all but the image, the image."""
    image = np.ascontiguousarray(entry.frame.image_dn)
    frame = replace(entry.frame, image_dn=NO_IMAGE)
    packed = pack((image.shape, image.dtype.str, replace(entry, frame=frame)))
    length = len(packed).to_bytes(EIGHTH, "little")
    return length, packed + bytes(-len(packed) % EIGHTH), image.view(np.uint8)


def unpack_entry(record: UInt8) -> Entry:
    """Return the entry of a record."""
    end = EIGHTH + int.from_bytes(record[:EIGHTH].tobytes(), "little")
    shape, dtype, entry = unpack(record[EIGHTH:end])
    held: Entry = entry
    image = record[end + -end % EIGHTH :].view(np.dtype(dtype)).reshape(shape)
    return replace(held, frame=replace(held.frame, image_dn=image))
