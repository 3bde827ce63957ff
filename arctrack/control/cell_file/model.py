"""cell.toml's tables; what the values must be beyond their bounds is said by the records that they make."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_type_hints

from pydantic import Field, create_model

from arctrack.control.cell_file.choices import (
    MIN_TOKEN_LETTERS,
    AgainChoice,
    BlackBoxChoice,
    CaptureChoice,
    McapChoice,
    MonitorChoice,
    ProcessChoice,
)
from arctrack.control.job import PartLimits
from arctrack.control.policy import ServicePolicy
from arctrack.recording.follow_tables import FollowTable
from arctrack.recording.scene_tables import JointTable
from arctrack.recording.schema import Bounds, Table, key
from arctrack.recording.sensor_tables import Number
from robot_io import GateLimits
from robot_io.poses.plausibility_limits import PlausibilityLimits

FORMAT = "arctrack-cell/1"

MAX_JOB_NUMBER = 65_534
"""The largest job number that the bus carries."""

KEYS_OF_KIND: dict[str, tuple[str, ...]] = {
    "shared_memory": ("exposure", "exposure_range_s"),
    "recording": (),
    "video": ("loop",),
    "folder": ("loop",),
    "device": (),
    "profile_tcp": (),
    "gige": tuple(f.name for f in fields(CaptureChoice) if f.name != "loop"),
}
"""Keys of [camera] by its kind, in addition to kind, name and frame_rate_hz."""

Range = Annotated[list[Number], Field(min_length=2, max_length=2)]
Rows = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]
Rate = Annotated[float, Field(gt=0.0, le=10_000.0)]


def _table_of(record: type, heading: str) -> type[Table]:
    """Return the table whose keys are a record's fields, each optional."""
    hints = get_type_hints(record)
    keys: dict[str, Any] = {}
    for f in fields(record):
        role, source = (
            f"{text[:1].upper()}{text[1:]}" for text in (f.metadata["role"], f.metadata["source"])
        )
        statement = key(role, f.metadata["unit"], default=f.default, note=f"{source}.")
        keys[f.name] = (Number if hints[f.name] is float else hints[f.name], statement)
    return create_model(f"{record.__name__}Table", __base__=Table, __doc__=heading, **keys)


if TYPE_CHECKING:
    # A type that is made cannot be checked by name; its keys are.
    GateTable: TypeAlias = Table
    ServiceTable: TypeAlias = Table
    PlausibilityTable: TypeAlias = Table
else:
    GateTable = _table_of(GateLimits, "Limits of an offset before it is sent.")
    ServiceTable = _table_of(ServicePolicy, "Ages at which messages and frames are stale.")
    PlausibilityTable = _table_of(
        PlausibilityLimits,
        "The robot's largest motions: poses beyond them are doubted. State your robot's own.",
    )


class BusTable(Table):
    """Way to the robot: python-can's interface and channel, or a robot's own protocol.

    virtual goes to nobody: try things out with it first.
    """

    interface: str = key(
        'The interface; on a robot "socketcan", "slcan", …, or "tcp_json", "egm", "rsi", "rtde"',
        example='"virtual"',
        min_length=1,
    )
    channel: str = key(
        'The channel, such as "can0", "/dev/ttyACM0"; of a robot\'s protocol HOST:PORT',
        example='"arctrack"',
        min_length=1,
    )
    bit_rate_bit_s: int = key(
        "The bit rate of CAN",
        "bit/s",
        default=500_000,
        bounds=Bounds(10_000, 1_000_000, "what classic CAN has"),
    )
    running_word: int | None = key(
        "The program's word while RAPID runs, for an EGM controller that sends none (RobotWare 6)",
        default=None,
        bounds=Bounds(0, 2**32 - 1, "it has 32 bits"),
    )


class CellCameraTable(Table):
    """The source of frames: docs/reference/cameras.md has the kinds, their names and keys."""

    frame_rate_hz: Rate = key(
        "Frame rate", "Hz", example="25.0", note="Four messages go with each frame: the bus' load."
    )
    kind: Literal["shared_memory", "recording", "video", "folder", "device", "gige", "profile_tcp"] | None = (
        key(
            "Where the frames of a live run come from",
            default=None,
            example='"shared_memory"',
            note='"shared_memory": another process publishes them; "recording": one is played.',
        )
    )
    name: str | None = key(
        "Which one of its kind: a name of frames, a file, a folder, a device, an id or address, HOST:PORT",
        default=None,
        example='"cell"',
        min_length=1,
    )
    loop: bool = key("Whether a file begins again at its end", default=CaptureChoice.loop)
    rows: Rows | None = key(
        "The first row that is read, and how many", default=None, note="The setup's height is their count."
    )
    trigger: Literal["free", "software", "hardware"] = key(
        "What begins a frame", default=CaptureChoice.trigger, note='"software": the host triggers each frame.'
    )
    trigger_line: str | None = key(
        'The camera\'s line that triggers it, for "hardware"', default=None, min_length=1
    )
    laser_line: str | None = key(
        "The camera's line that drives the laser, else it has no hold on it", default=None, min_length=1
    )
    laser: Literal["strobe", "switch"] = key(
        "How that line drives it",
        default=CaptureChoice.laser,
        note='"strobe": on during each exposure; "switch": on all the time, by UserOutput1.',
    )
    interleave: int | None = key(
        "N: each N-th frame is taken without the laser",
        default=None,
        note='It needs trigger "software" and laser_line.',
        bounds=Bounds(2, None, "others have the stripe"),
    )
    exposure: Literal["fixed", "predicted"] = key(
        "Whether the exposure is the setup's, or chosen ahead", default=CaptureChoice.exposure
    )
    exposure_range_s: Range | None = key(
        'The least and the largest exposure, for "predicted"', "s", default=None
    )


class ProcessTable(Table):
    """The scheduling of arctrack serve. A line at the start names what the machine does not allow."""

    priority: int | None = key(
        "Its real-time priority, SCHED_FIFO",
        default=ProcessChoice.priority,
        example="50",
        note="It needs rtprio in /etc/security/limits.conf.",
        bounds=Bounds(1, 99, "Linux has these"),
    )
    cpus: list[Annotated[int, Field(ge=0)]] | None = key(
        "The processors that it may run on", default=ProcessChoice.cpus, example="[1]", min_length=1
    )
    lock_memory: bool = key(
        "Whether its memory is kept from being swapped out, mlockall",
        default=ProcessChoice.lock_memory,
        example="true",
        note="It needs memlock in /etc/security/limits.conf.",
    )


class MonitorTable(Table):
    """The page of a live run. Other machines reach it where host says so; then a token must be stated."""

    enabled: bool = key("Whether there is a page", default=MonitorChoice.enabled)
    host: str = key(
        'The address; "0.0.0.0" is each of this machine', default=MonitorChoice.host, min_length=1
    )
    port: int = key(
        "Its port; 0 takes a free one", default=MonitorChoice.port, bounds=Bounds(0, 65_535, "what IP has")
    )
    token: str | None = key(
        "What a browser must bring; needed wherever other machines reach the page",
        default=MonitorChoice.token,
        example='"sixteen letters or more"',
        min_length=MIN_TOKEN_LETTERS,
    )


class BlackBoxTable(Table):
    """The black box of a live run: its latest frames go to disk on a fault, as a recording."""

    seconds: float = key(
        "How far back it reaches",
        "s",
        default=BlackBoxChoice.seconds,
        bounds=Bounds(0.0, 3600.0, "0 for none"),
    )
    folder: str = key(
        "Where its recordings go, from this file on", default=BlackBoxChoice.folder, min_length=1
    )


class McapTable(Table):
    """Live runs as MCAP, for Foxglove and what reads it beside ROS. It needs pip install 'arctrack[mcap]'."""

    folder: str | None = key(
        "Where each run writes a file, from this file on; none without it",
        default=McapChoice.folder,
        example='"mcap"',
        min_length=1,
    )


class PartTable(Table):
    """The part's required geometry before the arc is lit, as ranges; nothing is required without them."""

    gap_mm: Range | None = key("The gap, as in SeamGeometry", "mm", default=None, example="[0.0, 1.5]")
    mismatch_mm: Range | None = key(
        "The mismatch, as in SeamGeometry", "mm", default=None, example="[-0.8, 0.8]"
    )
    depth_mm: Range | None = key(
        "The depth of a V-groove or a half V",
        "mm",
        default=None,
        example="[3.5, 4.5]",
        note="By its opening's area A, gap g and bevels l, r: A = g d + d² (tan l + tan r)/2.",
    )
    angle_deg: Range | None = key(
        "The angle between a groove's faces, or plates", "deg", default=None, example="[55.0, 65.0]"
    )
    looks: int = key(
        "How many frames in a row must agree", default=PartLimits.looks, note="A bad frame refuses no part."
    )


class AgainTable(Table):
    """An earlier pass that the job follows again, displaced; without it the job follows what it sees."""

    seam: str = key(
        "The file of the earlier pass's seam, from this file on: keep_seam of its job",
        example='"root.json"',
        min_length=1,
    )
    side_mm: Number = key(
        "How far the pass lies to the left of that seam", "mm", default=AgainChoice.side_mm, example="2.5"
    )
    height_mm: Number = key(
        "How far it lies above that seam, out of the part",
        "mm",
        default=AgainChoice.height_mm,
        example="3.0",
    )
    tilt_deg: Number = key(
        "How much farther the tool leans to the right of the travel than in that pass",
        "deg",
        default=AgainChoice.tilt_deg,
        example="15.0",
        note="A tool that leans otherwise by more than 10 deg gets no offset.",
        bounds=Bounds(-90.0, 90.0, "a torch stands over the part"),
    )
    reverse: bool = key(
        "Whether the pass goes the other way; left is then that of its own travel",
        default=AgainChoice.reverse,
    )
    laser: bool = key(
        "Whether the sensor sees the seam, too; false keeps the laser off",
        default=AgainChoice.laser,
        note="With it both count, each by its sigma.",
    )
    sigma_mm: Number = key(
        "What part and robot may have moved since, 1 sigma",
        "mm",
        default=AgainChoice.sigma_mm,
        note="A robot comes back to 0.03 to 0.08; measure what the welding shrinks.",
    )
    max_age_s: Number = key(
        "The oldest seam with which a live pass begins",
        "s",
        default=AgainChoice.max_age_s,
        note="Another part may lie there by then.",
    )

    def to_choice(self, folder: Path) -> AgainChoice:
        """Return the choice of a cell file in a folder; ValueError names the key."""
        return AgainChoice(**{**self.known, "seam": folder / self.seam})


class JobTable(Table):
    """A job for each number N by which the robot names one, TrackerCommand.job_number."""

    name: str = key("What people call it", example='"first job"')
    offsets_in_search: bool = key("Whether offsets go out while the robot commands SEARCH", default=False)
    bridge_mm: Number | None = key(
        "How far a tack or another stretch without a joint may reach", "mm", default=None, example="8.0"
    )
    keep_seam: str | None = key(
        "The file that keeps the pass's seam, from this file on, for a job that follows it again",
        default=None,
        example='"kept.json"',
        min_length=1,
    )
    schedule: str | None = key(
        "The weld schedule, from this file on: a CSV table of speed, weave and wire by gap or area",
        default=None,
        example='"schedule.csv"',
        min_length=1,
    )
    joint: JointTable | None = None
    again: AgainTable | None = None
    follow: FollowTable = Field(default_factory=FollowTable)
    part: PartTable = Field(default_factory=PartTable)


class CellToml(Table):
    """The whole file."""

    format: Literal["arctrack-cell/1"] = key("The file's format", example=f'"{FORMAT}"')
    setup: str = key("The file of the setup, from this file on", example='"setup.toml"', min_length=1)
    bus: BusTable
    camera: CellCameraTable
    jobs: dict[str, JobTable] = Field(min_length=1)
    gate: GateTable = Field(default_factory=GateTable)
    service: ServiceTable = Field(default_factory=ServiceTable)
    process: ProcessTable = Field(default_factory=ProcessTable)
    black_box: BlackBoxTable = Field(default_factory=BlackBoxTable)
    mcap: McapTable = Field(default_factory=McapTable)
    monitor: MonitorTable = Field(default_factory=MonitorTable)
    plausibility: PlausibilityTable = Field(default_factory=PlausibilityTable)
