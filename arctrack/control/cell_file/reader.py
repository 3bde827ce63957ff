"""The one reader of cell files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from arctrack.control.cell_file.choices import (
    BlackBoxChoice,
    BusChoice,
    CameraChoice,
    CaptureChoice,
    CellFile,
    CellJob,
    McapChoice,
    MonitorChoice,
    ProcessChoice,
)
from arctrack.control.cell_file.model import (
    FORMAT,
    KEYS_OF_KIND,
    MAX_JOB_NUMBER,
    CellCameraTable,
    CellToml,
    JobTable,
    PartTable,
)
from arctrack.control.job import PartLimits
from arctrack.control.policy import ServicePolicy
from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.key_errors import place, wrong_keys
from arctrack.recording.schema import Table, unknown_in
from arctrack.recording.setup_file import SetupFile, read_setup_file
from arctrack.recording.toml_text import parse_toml
from noise_model.spelling import cure_for
from robot_io import GateLimits
from robot_io.poses.plausibility_limits import PlausibilityLimits

if TYPE_CHECKING:
    from noise_model.surface.joint import Joint

R = TypeVar("R")


def read_cell_file(path: Path | str) -> CellFile:
    """Read a cell file and the setup that it points to.

    ArctrackError names the file and the key or line that is wrong. A key that is not known is wrong.
    """
    path = Path(path)
    model = stated_keys(path)
    setup = read_setup_file(path.parent / model.setup)
    try:
        return _cell(path, model, setup)
    except ValueError as error:
        raise in_file(path, str(error)) from None


def stated_keys(path: Path) -> CellToml:
    """Return the keys of a cell file; ArctrackError for one that is missing, not known or of another type."""
    if path.is_dir():
        raise in_file(path, "is a folder; give the cell.toml in it")
    with blamed_on(path, "there is no such file; arctrack cell new writes one"):
        text = read_text(path, LIMITS.toml_bytes)
    try:
        document = parse_toml(text)
        if document.get("format") == "joint-tracking-recording/1":
            raise ValueError(f"is a setup; a cell file states format = {FORMAT!r}")
        model = CellToml.model_validate(document)
    except ValueError as error:
        raise wrong_keys(path, error, CellToml) from None
    for location, known in unknown_in(model):
        raise in_file(path, f"{place(location)}: is not known; {cure_for(location[-1], sorted(known))}")
    return model


def is_cell_file(path: Path) -> bool:
    """Return True if a file states that it is a cell file; False for what cannot be read."""
    try:
        return parse_toml(read_text(path, LIMITS.toml_bytes)).get("format") == FORMAT
    except (OSError, ValueError):
        return False


def _cell(path: Path, model: CellToml, setup: SetupFile) -> CellFile:
    limits = _record(GateLimits, model.gate, "gate limit", "[gate]")
    cell = CellFile(
        path=path,
        setup=setup,
        bus=_record(BusChoice, model.bus),
        camera=_camera(model.camera),
        limits=limits,
        policy=_record(ServicePolicy, model.service, "service policy", "[service]"),
        plausibility=_record(PlausibilityLimits, model.plausibility, "plausibility limit", "[plausibility]"),
        jobs=dict(sorted((_number(key), _job(key, table, path.parent)) for key, table in model.jobs.items())),
        process=_record(ProcessChoice, model.process),
        monitor=_record(MonitorChoice, model.monitor),
        black_box=_record(BlackBoxChoice, model.black_box),
        mcap=_record(McapChoice, model.mcap),
    )
    for number, job in cell.jobs.items():
        _within(str(number), partial(job.to_job, setup.setup, limits))
    if cell.bus_load >= 1.0:
        raise ValueError(
            f"[bus] bit_rate_bit_s = {cell.bus.bit_rate_bit_s}: {cell.camera.frame_rate_hz:g} frames a "
            f"second take {100.0 * cell.bus_load:.0f} % of it; choose a higher one, or fewer frames"
        )
    return cell


def _camera(table: CellCameraTable) -> CameraChoice:
    if (table.kind is None) != (table.name is None):
        missing = "kind" if table.kind is None else "name"
        raise ValueError(f"[camera] {missing}: missing; a camera is stated by kind and name")
    return CameraChoice(table.frame_rate_hz, table.kind, table.name, _capture(table))


def _capture(table: CellCameraTable) -> CaptureChoice:
    """Return the capture of a camera's frames; ValueError for a key that does not belong to its kind."""
    stated = {
        f.name: getattr(table, f.name) for f in fields(CaptureChoice) if f.name in table.model_fields_set
    }
    known = () if table.kind is None else KEYS_OF_KIND[table.kind]
    for key in stated:
        if key not in known:
            kinds = ", ".join(kind for kind, keys in KEYS_OF_KIND.items() if key in keys)
            raise ValueError(f"[camera] {key}: is of kind {kinds} alone; leave it out")
    if table.rows is not None:
        if table.rows[1] == 0:
            raise ValueError(
                f"[camera] rows = {table.rows}: is the first row and how many; choose one at least"
            )
        stated["rows"] = tuple(table.rows)
    if (table.trigger == "hardware") != (table.trigger_line is not None):
        raise ValueError("[camera] trigger_line: goes with trigger = 'hardware', and it with trigger_line")
    if "laser" in stated and table.laser_line is None:
        raise ValueError("[camera] laser: says how laser_line drives the laser; state laser_line too")
    if table.interleave is not None and (table.trigger != "software" or table.laser_line is None):
        raise ValueError(
            f"[camera] interleave = {table.interleave}: the laser is switched before a frame is triggered; "
            "state trigger = 'software' and laser_line too"
        )
    if (table.exposure == "predicted") != (table.exposure_range_s is not None):
        raise ValueError(
            "[camera] exposure_range_s: goes with exposure = 'predicted', and it with exposure_range_s"
        )
    if table.exposure_range_s is not None:
        min_s, max_s = table.exposure_range_s
        if not 0.0 < min_s < max_s:
            raise ValueError(f"[camera] exposure_range_s = {table.exposure_range_s}: must rise from above 0")
        stated["exposure_range_s"] = (min_s, max_s)
    return CaptureChoice(**stated)


def _record(record: Callable[..., R], table: Table, called: str = "", place: str = "") -> R:
    """Return the record that a table makes; in a ValueError `place` stands for what the record is called."""
    values = {name: tuple(held) if isinstance(held, list) else held for name, held in table.known.items()}
    try:
        return record(**values)
    except ValueError as error:
        raise ValueError(str(error).replace(called, place, 1)) from None


def _number(key: str) -> int:
    if not (key.isascii() and key.isdigit() and int(key) <= MAX_JOB_NUMBER and key == str(int(key))):
        raise ValueError(f"[jobs.{key}]: a job has a whole number from 0 to {MAX_JOB_NUMBER}")
    return int(key)


def _job(key: str, table: JobTable, folder: Path) -> CellJob:
    def built() -> CellJob:
        joint: Joint | None = None if table.joint is None else table.joint.to_joint()
        again = None if table.again is None else table.again.to_choice(folder)
        correction = table.follow.to_correction()
        return CellJob(
            name=table.name,
            joint=joint,
            correction=correction if again is None else again.displaced(correction),
            offsets_in_search=table.offsets_in_search,
            part=_part(table.part),
            bridge_mm=table.bridge_mm,
            keep_seam=None if table.keep_seam is None else folder / table.keep_seam,
            schedule=None if table.schedule is None else folder / table.schedule,
            again=again,
        )

    return _within(key, built)


def _part(table: PartTable) -> PartLimits:
    try:
        return _record(PartLimits, table)
    except ValueError as error:
        raise ValueError(f"[part] {error}") from None


def _within(key: str, build: Callable[[], R]) -> R:
    """Return the record built of a job; ValueError names the job's own table."""
    try:
        return build()
    except ValueError as error:
        text = str(error)
        inner = text.startswith("[")
        raise ValueError(f"[jobs.{key}.{text[1:]}" if inner else f"[jobs.{key}] {text}") from None
