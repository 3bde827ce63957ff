"""calibration.toml and the folders beside it: what is where, and what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from arctrack.calibrate.all.folder import FILE_NAME, CalibrationSources, read_raw_files
from arctrack.errors import ArctrackError


def folder_with(path: Path, text: str | None, *folders: str) -> Path:
    for name in folders:
        (path / name).mkdir(parents=True)
    if text is not None:
        (path / FILE_NAME).write_text(text)
    return path


def read(path: Path, text: str | None, *folders: str) -> CalibrationSources:
    return read_raw_files(folder_with(path, text, *folders))


def test_files_lie_in_the_folders_of_the_calibrations_names(tmp_path: Path) -> None:
    (tmp_path / "hand_eye").mkdir()
    (tmp_path / "hand_eye" / "poses.csv").touch()
    raw = read(tmp_path, 'board = "chessboard:9x6:4mm"\n[hand_eye]\nrotation = "abb"', "camera", "sensor")
    assert raw.camera is not None
    assert raw.camera.sources == (tmp_path / "camera",)
    assert str(raw.camera.board) == "chessboard:9x6:4mm"
    assert raw.hand_eye is not None
    assert (raw.hand_eye.poses.path, raw.hand_eye.poses.rotation) == (
        tmp_path / "hand_eye" / "poses.csv",
        "abb",
    )
    assert raw.sensor is not None
    assert raw.sensor.source == tmp_path / "sensor"
    assert (raw.laser, raw.delay, raw.arc) == (None, None, None)
    assert list(raw.warnings) == []


def test_one_series_may_serve_several_calibrations(tmp_path: Path) -> None:
    (tmp_path / "series").mkdir()
    text = """
        [camera]
        board = "chessboard:9x6:4mm"
        images = "series/*_off.png"
        [laser]
        board = "chessboard:8x6:2.5mm"
        images = "series"
    """
    raw = read(tmp_path, text)
    assert raw.camera is not None
    assert raw.camera.sources == (tmp_path / "series" / "*_off.png",)
    assert raw.laser is not None
    assert str(raw.laser.board) == "chessboard:8x6:2.5mm"


@pytest.mark.parametrize(
    ("text", "folders", "why"),
    [
        (None, (), "holds nothing to calibrate with: make a subfolder sensor, camera"),
        (None, ("camera",), "[camera] board: missing; board = "),
        ('board = "9x6"', ("laser",), "board: '9x6' is no board"),
        ('[laser]\nboard = "9x6"', ("laser",), "[laser] board: '9x6' is no board"),
        ('[delay]\nrecording = "gone"', (), "[delay] recording: there is no "),
        (
            '[camera]\ndistortion = "k9"\nboard = "chessboard:9x6:4mm"',
            ("camera",),
            "distortion = 'k9': must be 'none', 'k1', ",
        ),
        (
            "[sensor]\ngamma = 12.0",
            ("sensor",),
            "[sensor] gamma = 12.0: input should be less than or equal to 10; usual: 1",
        ),
        ("[sensor]\ngamma = true", ("sensor",), "[sensor] gamma = True: input should be a valid number"),
        ("board = ", ("camera",), "is no valid TOML"),
    ],
)
def test_what_is_wrong_is_named(text: str | None, folders: tuple[str, ...], why: str, tmp_path: Path) -> None:
    with pytest.raises(ArctrackError) as raised:
        read(tmp_path, text, *folders)
    assert why in str(raised.value)
    assert str(tmp_path) in str(raised.value)


def test_keys_that_mean_nothing_are_named_with_those_that_are_near(tmp_path: Path) -> None:
    raw = read(tmp_path, "[sensor]\ngama = 0.5\n[lasers]\nboard = 3", "sensor")
    file = tmp_path / FILE_NAME
    assert list(raw.warnings) == [
        f"{file}: [lasers] is not known and has no effect; did you mean laser?",
        f"{file}: [sensor] gama is not known and has no effect; did you mean gamma?",
    ]
