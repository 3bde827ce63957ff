"""The tables of calibration.toml: what the raw files of `arctrack calibrate all` are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

from arctrack.recording.schema import Table, key
from arctrack.recording.sensor_tables import GAMMA
from calibration.camera.lens import ORDERS

if TYPE_CHECKING:
    # A type that is made cannot be checked by name; its values are.
    Distortion: TypeAlias = str
else:
    Distortion = Literal[tuple(ORDERS)]

OWN_FOLDER = "Else the subfolder of the table's name."


class BoardImagesTable(Table):
    """Images of a board, for the laser without and with the stripe."""

    images: str | None = key(
        "A folder of images, or a pattern such as series/*_off.png, from this file on",
        default=None,
        note=OWN_FOLDER,
    )
    board: str | None = key(
        "The board on these images", default=None, note="Else the board that the file states for all."
    )


class CameraImagesTable(BoardImagesTable):
    """Images of a board for the camera's lens."""

    distortion: Distortion | None = key(
        "The coefficients of the lens' distortion", default=None, note="Else the images decide."
    )
    tilted: bool = key("Whether the sensor is tilted to the lens, after Scheimpflug", default=False)


class PosedImagesTable(BoardImagesTable):
    """Images of a board from several poses of the robot."""

    poses: str | None = key(
        "The robot's pose of each image: a table or matrices", default=None, note="Else hand_eye/poses.csv."
    )
    translations: str | None = key("The translations to a file of rotation matrices alone", "", default=None)
    rotation: str | None = key(
        "The notation of rotations: a robot's make, an order of quaternions or axes, or matrix",
        "",
        "kuka, fanuc, abb, ur, staubli, yaskawa, xyzw, wxyz, rotvec, ZYX",
        default=None,
        note="Else the columns qx, qy, qz, qw.",
    )
    units: str | None = key(
        "The units of columns that do not name theirs",
        "",
        '"m, rad"',
        default=None,
        note="A column x_mm does.",
    )
    columns: dict[str, str] | None = key(
        'The names that the file has for columns, such as { x = "tcp_x" }', default=None
    )
    eye_to_hand: bool = key("Whether the camera stands still and the robot carries the board", default=False)


class FlatFramesTable(Table):
    """Flat and dark frames of the sensor, or a recording of a still stripe."""

    images: str | None = key("The folder of frames, or the recording", default=None, note=OWN_FOLDER)
    gamma: float | None = key(
        "The response's exponent, held rather than fitted", "", "1", default=None, bounds=GAMMA
    )


class RecordingTable(Table):
    """A recording: for the delay one whose tool weaves, for the arc one with frames of the arc alone."""

    recording: str | None = key("The recording's folder, from this file on", default=None, note=OWN_FOLDER)


class CalibrationToml(Table):
    """The whole file."""

    board: str | None = key(
        "The board of all tables that state none: its kind, inner corners across and down, and a square's "
        "side",
        "",
        "chessboard:9x6:4mm",
        default=None,
    )
    sensor: FlatFramesTable | None = None
    camera: CameraImagesTable | None = None
    hand_eye: PosedImagesTable | None = None
    laser: BoardImagesTable | None = None
    delay: RecordingTable | None = None
    arc: RecordingTable | None = None
