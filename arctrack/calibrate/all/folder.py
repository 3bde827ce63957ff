"""A folder of raw files for all calibrations, and calibration.toml in it, which says what they are.

The file may be short: a stage's files lie in the subfolder of its name unless the file says otherwise.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from arctrack.calibrate.all.calibration_tables import (
    BoardImagesTable,
    CalibrationToml,
    CameraImagesTable,
    FlatFramesTable,
    PosedImagesTable,
    RecordingTable,
)
from arctrack.calibrate.robot_poses import PoseSource
from arctrack.errors import ArctrackError, in_file, no_such_path
from arctrack.limits import LIMITS
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.importing.image_files import images_of
from arctrack.recording.importing.units import parse_units
from arctrack.recording.key_errors import place, wrong_keys
from arctrack.recording.schema import unknown_in
from arctrack.recording.toml_text import parse_toml
from calibration.boards.board import Board
from calibration.camera.lens import ORDERS
from noise_model.spelling import nearest

FILE_NAME = "calibration.toml"
BOARD_HINT = 'board = "chessboard:9x6:5mm" counts inner corners'
STAGES = ("sensor", "camera", "hand_eye", "laser", "delay", "arc")
"""The calibrations in the order in which they build on each other."""


@dataclass(frozen=True)
class BoardFiles:
    """Images of a board, and the board."""

    sources: tuple[Path, ...]
    board: Board


@dataclass(frozen=True)
class CameraFiles(BoardFiles):
    """The camera's images, the distortions to choose from, and whether the sensor is tilted."""

    orders: tuple[str, ...]
    tilted: bool


@dataclass(frozen=True)
class PosedFiles(BoardFiles):
    """Images of a board, and the file of the robot's poses with how it is written."""

    poses: PoseSource
    is_eye_to_hand: bool


@dataclass(frozen=True)
class SensorFiles:
    """A folder of flat and dark frames, or a recording of a still stripe, and a gamma that is held."""

    source: Path
    gamma: float | None


@dataclass(frozen=True)
class CalibrationSources:
    """Inputs of each calibration in a folder, None where there are none.

    `unknown_keys` are unknown keys of calibration.toml, each with the known key nearest to it.
    """

    folder: Path
    sensor: SensorFiles | None
    camera: CameraFiles | None
    hand_eye: PosedFiles | None
    laser: BoardFiles | None
    delay: Path | None
    arc: Path | None
    unknown_keys: dict[str, str | None]

    @property
    def images(self) -> list[Path]:
        """The images of boards."""
        boards = (self.camera, self.hand_eye, self.laser)
        return [path for files in boards if files is not None for path in images_of(files.sources)]

    @property
    def warnings(self) -> Iterator[str]:
        """Warnings about calibration.toml, a line each."""
        for key, near in self.unknown_keys.items():
            hint = "" if near is None else f"; did you mean {near}?"
            yield f"{self.folder / FILE_NAME}: {key} is not known and has no effect{hint}"


def read_raw_files(folder: Path) -> CalibrationSources:
    """Return the places of a folder's files for each calibration; whether they hold anything is not checked.

    A subfolder named after a calibration holds its files: `sensor`, `camera`, `hand_eye`, `laser`, `delay`,
    `arc`. calibration.toml has the other inputs, and may name other places. Raises ArctrackError for a folder
    that holds none, and for a key that is wrong or missing.
    """
    if not folder.is_dir():
        if folder.exists():
            raise in_file(folder, "is a file; give the folder")
        raise no_such_path(folder, "there is no such folder", Path.is_dir)
    stated = _stated(folder)
    here = {name for name in STAGES if getattr(stated, name) is not None or (folder / name).is_dir()}
    if not here:
        raise in_file(folder, f"holds nothing to calibrate with: make a subfolder {', '.join(STAGES)}")
    reading = _Reading(folder, stated, here)
    return CalibrationSources(
        folder=folder,
        sensor=reading.sensor(),
        camera=reading.camera(),
        hand_eye=reading.hand_eye(),
        laser=reading.board_files("laser", stated.laser),
        delay=reading.recording("delay", stated.delay),
        arc=reading.recording("arc", stated.arc),
        unknown_keys={
            place(location): nearest(location[-1], known) for location, known in unknown_in(stated)
        },
    )


def by_keys(stage: str, error: ArctrackError) -> str:
    """Return a calibration's error with keys of calibration.toml for the options of its single command."""
    return re.sub(r"--(units|rotation|board)\b", rf"[{stage}] \1", str(error))


def _stated(folder: Path) -> CalibrationToml:
    path = folder / FILE_NAME
    if not path.exists():
        return CalibrationToml()
    with blamed_on(path):
        text = read_text(path, LIMITS.toml_bytes)
    try:
        return CalibrationToml.model_validate(parse_toml(text))
    except ValueError as error:
        raise wrong_keys(path, error, CalibrationToml) from None


@dataclass(frozen=True)
class _Reading:
    folder: Path
    stated: CalibrationToml
    here: set[str]

    def sensor(self) -> SensorFiles | None:
        if "sensor" not in self.here:
            return None
        table = self.stated.sensor or FlatFramesTable()
        return SensorFiles(self.path("sensor", "images", table.images or "sensor"), table.gamma)

    def camera(self) -> CameraFiles | None:
        table = self.stated.camera or CameraImagesTable()
        files = self.board_files("camera", table)
        if files is None:
            return None
        orders = tuple(ORDERS) if table.distortion is None else (table.distortion,)
        return CameraFiles(files.sources, files.board, orders, table.tilted)

    def hand_eye(self) -> PosedFiles | None:
        table = self.stated.hand_eye or PosedImagesTable()
        files = self.board_files("hand_eye", table)
        if files is None:
            return None
        poses = self.path("hand_eye", "poses", table.poses or "hand_eye/poses.csv")
        translations = (
            None if table.translations is None else self.path("hand_eye", "translations", table.translations)
        )
        try:
            units = parse_units(table.units or "")
        except ArctrackError as error:
            raise in_file(self.folder / FILE_NAME, by_keys("hand_eye", error)) from None
        source = PoseSource(poses, translations, table.rotation, units, table.columns or {})
        return PosedFiles(files.sources, files.board, source, table.eye_to_hand)

    def board_files(self, stage: str, table: BoardImagesTable | None) -> BoardFiles | None:
        if stage not in self.here:
            return None
        table = table or BoardImagesTable()
        pattern = table.board or self.stated.board
        file = self.folder / FILE_NAME
        if pattern is None:
            raise in_file(file, f"[{stage}] board: missing; {BOARD_HINT}")
        try:
            board = Board.parse(pattern)
        except ValueError as error:
            key = "board" if table.board is None else f"[{stage}] board"
            raise in_file(file, f"{key}: {error}") from None
        images = self.path(stage, "images", table.images or stage, may_be_pattern=True)
        return BoardFiles((images,), board)

    def recording(self, stage: str, table: RecordingTable | None) -> Path | None:
        if stage not in self.here:
            return None
        return self.path(stage, "recording", (table or RecordingTable()).recording or stage)

    def path(self, stage: str, key: str, value: str, *, may_be_pattern: bool = False) -> Path:
        path = self.folder / value
        if not path.exists() and not (may_be_pattern and any(sign in value for sign in "*?[")):
            raise in_file(self.folder / FILE_NAME, f"[{stage}] {key}: there is no {path}")
        return path
