"""recording.toml, read and written: pydantic models at the file's edge, `noise_model.setup.Setup` inside."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit
from tomlkit.items import Table

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.printable import cut, first_of, printable
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.key_errors import wrong_keys
from arctrack.recording.setup_model import CalibrationTable, RecordingToml, model_of, unknown_keys
from arctrack.recording.setup_writer import CERTIFICATE, FILE_NAME, GEOMETRY, filter_table, pose_table
from arctrack.recording.toml_text import parse_toml, rounded
from noise_model.compiled.arrays import Float64
from tracker.seam.correction import Correction

if TYPE_CHECKING:
    from noise_model.instrument.spectrum import FilterCurve
    from noise_model.setup import Setup
    from sim_to_real.diagnosis import NamedEffect


@dataclass(frozen=True)
class SetupFile:
    """Content of the recording.toml at `path`.

    `correction` is how the seam is followed; `robot` is the raw table; `T_tool_controllertool` (4, 4), mm,
    takes points of the controller's own tool frame to arctrack's, None if they are the same; `unknown_keys`
    are the keys that mean nothing here: they are reported and otherwise without effect. `nearest_keys` are
    the known keys that some of them may be meant for. `calibrations` are the `[calibration.NAME]` tables.
    """

    path: Path
    setup: Setup
    correction: Correction = field(default_factory=Correction)
    robot: Mapping[str, Any] = field(default_factory=dict)
    T_tool_controllertool: Float64 | None = None
    unknown_keys: tuple[str, ...] = ()
    nearest_keys: Mapping[str, str] = field(default_factory=dict)
    calibrations: Mapping[str, CalibrationTable] = field(default_factory=dict)

    def __repr__(self) -> str:
        joint, metal = self.setup.joint.type, printable(self.setup.material.name)
        unknown = f", {len(self.unknown_keys)} unknown keys" if self.unknown_keys else ""
        return f"SetupFile({printable(str(self.path))}: a {joint} in {metal}{unknown})"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user, one line each."""
        problems = []
        for key in self.unknown_keys:
            near = self.nearest_keys.get(key)
            hint = "" if near is None else f"; did you mean {near}?"
            problems.append(f"{cut(key)} is not known and has no effect{hint}")
        return tuple(f"{self.path}: {problem}" for problem in first_of(problems, "keys are not known"))


def read_setup_file(path: Path | str) -> SetupFile:
    """Read a recording.toml.

    Parameters
    ----------
    path : Path or str
        The file.

    Returns
    -------
    SetupFile
        The setup as its `setup`, and what else the file states.

    Raises
    ------
    ArctrackError
        It names the file and the key or line that is wrong.
    """
    path = Path(path)
    return parse_setup(setup_text(path), path)


def require_images(setup: Setup, path: Path, instead: str) -> None:
    """Raise ArctrackError, with what to do instead, for a setup whose camera is a profiler."""
    if setup.profiler is not None:
        raise in_file(path, f'[camera] kind = "profile": this reads images alone; {instead}')


def setup_text(path: Path) -> str:
    """Return the text of a recording.toml; ArctrackError if there is none."""
    if path.is_dir():
        raise in_file(path, f"is a folder; give the {FILE_NAME} in it")
    with blamed_on(path, "there is no such file; a recording needs one"):
        return read_text(path, LIMITS.toml_bytes)


def stated_keys(text: str, path: Path) -> RecordingToml:
    """Return the keys of a recording.toml's text; ArctrackError for one that is missing or of another type.

    `path` is for the messages.
    """
    kind: type[RecordingToml] = RecordingToml
    try:
        content = parse_toml(text)
        kind = model_of(content)
        model = kind.model_validate(content)
        model.joint.dimensions()
    except ValueError as error:
        raise wrong_keys(path, error, kind) from None
    return model


def parse_setup(text: str, path: Path) -> SetupFile:
    """Parse the text of a recording.toml; `path` is for the messages."""
    model = stated_keys(text, path)
    controllertool = None if model.robot is None else model.robot.controllertool_to_tool
    try:
        setup = model.to_setup()
        unknown = unknown_keys(model)
        return SetupFile(
            path=path,
            setup=setup,
            correction=model.follow.to_correction(),
            robot={} if model.robot is None else model.robot.model_dump(exclude_unset=True),
            T_tool_controllertool=None
            if controllertool is None
            else controllertool.matrix("robot.controllertool_to_tool"),
            unknown_keys=tuple(unknown),
            nearest_keys={key: near for key, near in unknown.items() if near is not None},
            calibrations=model.calibration,
        )
    except ValueError as error:
        raise in_file(path, str(error)) from None


def with_camera_pose(path: Path, T_tool_camera: Float64) -> str:
    """Return a recording.toml's text with another camera pose; all else, comments included, stays.

    Only the joint covariance of the former one goes.
    """
    read_setup_file(path)
    document = tomlkit.parse(setup_text(path))
    camera = document["camera"]
    for key, value in pose_table(T_tool_camera).items():
        camera["pose_in_tool"][key] = value
    end_joint_covariance(document)
    return tomlkit.dumps(document)


def end_joint_covariance(document: MutableMapping[str, Any]) -> None:
    """Take the joint covariance and its certificate out of a recording.toml: tolerances count again."""
    for name in (GEOMETRY, CERTIFICATE):
        document.get("calibration", {}).pop(name, None)


def with_camera_keys(path: Path, keys: Mapping[str, int | float]) -> str:
    """Return a recording.toml's text with other values in `[camera]`; all else, comments included, stays."""
    read_setup_file(path)
    document = tomlkit.parse(setup_text(path))
    for key, value in keys.items():
        document["camera"][key] = value
    return tomlkit.dumps(document)


def with_filter_curve(path: Path, curve: FilterCurve) -> str:
    """Return a recording.toml's text with a filter's measured curve; all else, comments included, stays."""
    read_setup_file(path)
    document = tomlkit.parse(setup_text(path))
    table = document.setdefault("filter", tomlkit.table())
    for key, value in filter_table(curve).items():
        table[key] = value
    return tomlkit.dumps(document)


def with_effects(path: Path, effects: Sequence[NamedEffect]) -> str:
    """Return a recording.toml's text that names effects which were found; all else, comments included, stays.

    Raises ArctrackError for a file that cannot be read, and for a value that it could not hold.
    """
    read_setup_file(path)
    document = tomlkit.parse(setup_text(path))
    named = document.setdefault("effects", tomlkit.table(is_super_table=True))
    for effect in effects:
        table = named.setdefault(effect.id, tomlkit.table())
        for key, estimate in effect.parameters.items():
            # Six digits: nobody knows it better, and the file stays readable.
            table[key] = rounded(estimate.value, 6)
            # A table on one line has no room for comments.
            if isinstance(table, Table):
                within = f"± {estimate.sigma:.2g}, " if math.isfinite(estimate.sigma) else ""
                table[key].comment(f"{within}found by arctrack diagnose")
    text = tomlkit.dumps(document)
    parse_setup(text, path)
    return text
