"""cell.toml's keys and types; what the values must be beyond that is said by the records that they make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_type_hints

from pydantic import Field, FiniteFloat, create_model

from arctrack.control.cell_file.choices import MIN_TOKEN_LETTERS, BlackBoxChoice, MonitorChoice
from arctrack.control.job import PartLimits
from arctrack.control.policy import ServicePolicy
from arctrack.recording.follow_tables import FollowTable
from arctrack.recording.key_errors import place
from arctrack.recording.scene_tables import JointTable
from arctrack.recording.schema import Table
from arctrack.recording.sensor_tables import Number
from noise_model.setup_keys import DIMENSIONS
from noise_model.spelling import cure_for
from robot_io import GateLimits
from robot_io.poses.plausibility_limits import PlausibilityLimits

FORMAT = "arctrack-cell/1"

MAX_JOB_NUMBER = 65_534
"""The largest job number that the bus carries."""

Range = Annotated[list[Number], Field(min_length=2, max_length=2)]
Rows = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]
Rate = Annotated[FiniteFloat, Field(gt=0.0, le=10_000.0)]


def _table_of(record: type) -> type[Table]:
    """Return the table whose keys are a record's fields, each optional."""
    hints = get_type_hints(record)
    keys: dict[str, Any] = {
        f.name: (Number if hints[f.name] is float else hints[f.name], f.default) for f in fields(record)
    }
    return create_model(f"{record.__name__}Table", __base__=Table, **keys)


if TYPE_CHECKING:
    # A type that is made cannot be checked by name; its keys are.
    GateTable: TypeAlias = Table
    ServiceTable: TypeAlias = Table
    PlausibilityTable: TypeAlias = Table
else:
    GateTable = _table_of(GateLimits)
    ServiceTable = _table_of(ServicePolicy)
    PlausibilityTable = _table_of(PlausibilityLimits)


class BusTable(Table):
    """[bus]."""

    interface: str = Field(min_length=1)
    channel: str = Field(min_length=1)
    bit_rate_bit_s: int = Field(default=500_000, ge=10_000, le=1_000_000)


class CellCameraTable(Table):
    """[camera]."""

    frame_rate_hz: Rate
    kind: Literal["shared_memory", "recording", "video", "folder", "device", "gige"] | None = None
    name: Annotated[str, Field(min_length=1)] | None = None
    loop: bool | None = None
    rows: Rows | None = None
    trigger: Literal["free", "software", "hardware"] | None = None
    trigger_line: Annotated[str, Field(min_length=1)] | None = None
    laser_line: Annotated[str, Field(min_length=1)] | None = None
    laser: Literal["strobe", "switch"] | None = None
    interleave: Annotated[int, Field(ge=2)] | None = None
    exposure: Literal["fixed", "predicted"] | None = None
    exposure_range_s: Range | None = None


class ProcessTable(Table):
    """[process], every key optional."""

    priority: Annotated[int, Field(ge=1, le=99)] | None = None
    cpus: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] | None = None
    lock_memory: bool = False


class MonitorTable(Table):
    """[monitor], every key optional."""

    host: str = Field(default=MonitorChoice.host, min_length=1)
    port: int = Field(default=MonitorChoice.port, ge=0, le=65_535)
    token: Annotated[str, Field(min_length=MIN_TOKEN_LETTERS)] | None = None
    enabled: bool = True


class BlackBoxTable(Table):
    """[black_box], every key optional."""

    seconds: Annotated[FiniteFloat, Field(ge=0.0, le=3600.0)] = BlackBoxChoice.seconds
    folder: Annotated[str, Field(min_length=1)] = BlackBoxChoice.folder


class PartTable(Table):
    """[jobs.N.part], every key optional."""

    gap_mm: Range | None = None
    mismatch_mm: Range | None = None
    depth_mm: Range | None = None
    angle_deg: Range | None = None
    looks: int = PartLimits.looks


class JobTable(Table):
    """[jobs.N]."""

    name: str
    joint: JointTable | None = None
    follow: FollowTable = Field(default_factory=FollowTable)
    offsets_in_search: bool = False
    bridge_mm: Number | None = None
    part: PartTable = Field(default_factory=PartTable)


class CellToml(Table):
    """The whole file."""

    format: Literal["arctrack-cell/1"]
    setup: str = Field(min_length=1)
    bus: BusTable
    camera: CellCameraTable
    gate: GateTable = Field(default_factory=GateTable)
    service: ServiceTable = Field(default_factory=ServiceTable)
    plausibility: PlausibilityTable = Field(default_factory=PlausibilityTable)
    process: ProcessTable = Field(default_factory=ProcessTable)
    monitor: MonitorTable = Field(default_factory=MonitorTable)
    black_box: BlackBoxTable = Field(default_factory=BlackBoxTable)
    jobs: dict[str, JobTable] = Field(min_length=1)


def unknown_keys(table: Table, location: tuple[str | int, ...] = ()) -> Iterator[str]:
    """Yield a line for each key that means nothing: which one it is, and which one may be meant."""
    known = {*type(table).model_fields}
    if isinstance(table, JointTable):
        # Of a type that there is not, nothing is known; that is said of the type.
        known |= {*DIMENSIONS.get(table.type, table.model_extra or {})}
    for name in table.model_extra or {}:
        if name not in known:
            yield f"{place((*location, name))}: is not known; {cure_for(name, sorted(known))}"
    for name in type(table).model_fields:
        value = getattr(table, name)
        inner = value.items() if isinstance(value, dict) else [(None, value)]
        for key, held in inner:
            if isinstance(held, Table):
                yield from unknown_keys(held, (*location, name) if key is None else (*location, name, key))
