"""What a live run hands on: an entry for each frame, a view of the newest one, and the state of it all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from arctrack.live.journal.packing import Packer
from noise_model.arrays import UInt8
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

EIGHTH = 8
"""Parts of a record begin at multiples of so many bytes."""

NO_IMAGE = np.empty((0, 0), np.uint8)

BUCKETS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 60.0)
"""Up to which times Prometheus is told counts, s: upper ends of bins. The gate lets out what is 0.2 s old."""


@dataclass(frozen=True)
class HeardPose:
    """A pose of the robot, its time on the frames' clock, and when it was read, s."""

    sample: PoseSample
    read_s: float


@dataclass(frozen=True)
class Entry:
    """A frame that was tracked.

    Attributes
    ----------
    frame : Frame
        The frame as the tracker saw it.
    inputs : StepInputs
        What the step took beside it.
    track : Track
        What came of it, without stripe and checks.
    offset : SeamOffset or None
        The offset that went out.
    job_number : int
        The job whose seam it is.
    poses : tuple of HeardPose
        The poses that came since the entry before.
    arrived_s, sent_s : float
        When the loop had the frame, and when its offset went out, s; NaN where it did not.
    took_ms : float
        How long the step took, ms.
    dropped : int
        How many frames were dropped since the start.
    gate_reason : GateReason
        Why the offset did not go out as it was measured; NONE if it did.
    pose_doubt : str
        Why poses were not trusted, by the name in `results.csv`; empty where they were.
    """

    frame: Frame
    inputs: StepInputs
    track: Track
    offset: SeamOffset | None
    job_number: int
    poses: tuple[HeardPose, ...] = ()
    arrived_s: float = NAN
    sent_s: float = NAN
    took_ms: float = NAN
    dropped: int = 0
    gate_reason: GateReason = GateReason.NONE
    pose_doubt: str = ""


@dataclass(frozen=True)
class SeenFrame:
    """What was seen in a frame, for those who look: its entry's position, and more than that holds.

    Attributes
    ----------
    position : int
        Of the frame's entry, from the first.
    track : Track
        The track with its stripe.
    seam : SeamLine or None
        Where the seam was looked for; None where nothing was.
    reach_mm : float
        How far about it, mm.
    arc : ArcLevel or None
        The arc's light.
    joint : MeasuredJoint or None
        The joint that was fitted.
    """

    position: int
    track: Track
    seam: SeamLine | None = None
    reach_mm: float = NAN
    arc: ArcLevel | None = None
    joint: MeasuredJoint | None = None


@dataclass(frozen=True)
class ProcessState:
    """How a process of the run stands, beside the loop's own.

    Attributes
    ----------
    pid : int
        The number of the process, or of the one that ended last.
    is_running : bool
        Whether it does its work.
    ends : int
        How often it has ended by itself; it was started again each time.
    problem : str
        What is wrong with it or its work; empty where nothing is.
    """

    pid: int
    is_running: bool
    ends: int
    problem: str


@dataclass(frozen=True)
class Status:
    """How the run stands.

    Attributes
    ----------
    now_s, wall_s : float
        The time on the frames' clock and of the day, s.
    source : Source
        Whether the run is live.
    state : ServiceState
        The state that the robot is told.
    fault : Fault
        What holds until RESET.
    laser : LaserState
        What the laser does.
    reason : GateReason
        Why the newest offset did not go out as measured; NONE where it did.
    offset : SeamOffset or None
        The newest offset that went out.
    robot : RobotStatus or None
        What the robot said last.
    command : TrackerCommand or None
        What it wants of the tracker.
    job_number : int
        The job whose seam is tracked.
    frames, valid, dropped : int
        How many frames were tracked, tracked validly, and dropped.
    offsets, reasons : mapping of str to int
        How many offsets went out by validity, and why not as measured.
    faults : mapping of str to int
        The bus' faults.
    capture_ms, arrival_ms : tuple (3,)
        Median, 99 % and largest time from mid-exposure and from the frame's arrival to its offset, ms.
    frame_s : float
        When the newest frame was taken, s; NaN before the first.
    processor_wait : float
        Which share of the time that the loop wants a processor it waits for one; NaN where that is not known.
    capture_counts, arrival_counts : tuple of int
        How many of these times were at most each of `BUCKETS_S`, and last how many there were.
    capture_sum_s, arrival_sum_s : float
        The sums of these times, s.
    processes : mapping of str to ProcessState
        The processes of the run beside the loop's own, by their names.
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
    """Whether the setup explains the latest frames, and what the arc looks like in them.

    Attributes
    ----------
    time_s : float
        When the newest frame that it rests on was taken, s.
    is_gap : bool
        Whether the arc map no longer explains the frames.
    text : str
        What that looks like, in plain words; empty where nothing is said.
    since_wall_s : float
        Since when it has been so, time of the day, s; NaN where there is no gap.
    arc_level, arc_level_sigma : float
        The arc's output over the expected one, and its 1 sigma; NaN where it is not known.
    arc_height_mm, arc_height_sigma_mm : float
        How high the arc's centre is above the surface, and its 1 sigma, mm; NaN where it is not known.
    """

    time_s: float
    is_gap: bool
    text: str = ""
    since_wall_s: float = NAN
    arc_level: float = NAN
    arc_level_sigma: float = NAN
    arc_height_mm: float = NAN
    arc_height_sigma_mm: float = NAN


_PACKER = Packer((Entry, SeenFrame, Status, GapReport))


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
