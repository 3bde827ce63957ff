import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from arctrack import cli
from arctrack.calibrate.sensor.flat_frames import find_flat_frames
from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording import RecordingWriter, format_setup, read_setup_file
from calibration.sensor.levels import level_from
from noise_model.setup import Setup
from tracker.state import Frame

RUNNER = CliRunner(env={"COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1"})
GAIN, BLACK, READ, SIDE = 50.0, 12.0, 40.0, 64
LIGHT_E_PER_MS = 1000.0


def draw_frame(exposure_ms: float, draw: np.random.Generator) -> np.ndarray:
    charge = draw.poisson(LIGHT_E_PER_MS * exposure_ms, (SIDE, SIDE)) + draw.normal(0.0, READ, (SIDE, SIDE))
    return np.clip(np.rint(BLACK + charge / GAIN), 0, 255).astype(np.uint8)


@pytest.fixture
def setup_toml(tmp_path: Path) -> Path:
    path = tmp_path / "recording.toml"
    path.write_text("# bought in May\n" + format_setup(nominal_setup("v_groove", "mild_steel")))
    return path


@pytest.fixture
def flats(tmp_path: Path) -> Path:
    """Grey and colour files of both depths, in folders and not, a JPEG, and one that says nothing."""
    folder, draw = tmp_path / "flats", np.random.default_rng(1)
    (folder / "dark_1ms").mkdir(parents=True)
    for n in range(2):
        cv2.imwrite(str(folder / "dark_1ms" / f"{n}.png"), draw_frame(0.0, draw))
        for name, ms in (("flat_1000us", 1), ("flat_2ms", 2), ("flat_0.004s", 4), ("flat_6ms", 6)):
            cv2.imwrite(str(folder / f"{name}_{n}.tif"), draw_frame(ms, draw).astype(np.uint16))
        red = np.dstack([np.zeros((SIDE, SIDE, 2), np.uint8), draw_frame(9, draw)])
        cv2.imwrite(str(folder / f"flat_9ms_{n}.png"), red)
    cv2.imwrite(str(folder / "flat_8ms_1.jpg"), draw_frame(8, draw))
    cv2.imwrite(str(folder / "bench.png"), draw_frame(8, draw))
    return folder


@pytest.mark.slow
def test_a_folder_of_frames_becomes_a_setup_and_a_page(flats: Path, setup_toml: Path, tmp_path: Path) -> None:
    before = setup_toml.read_text()
    result = RUNNER.invoke(cli.app, ["calibrate", "sensor", str(flats), "--setup", str(setup_toml)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "recording.toml.1").read_text() == before
    assert setup_toml.read_text().startswith("# bought in May\n")
    sensor = read_setup_file(setup_toml).setup.sensor
    record = tomllib.loads(setup_toml.read_text())["calibration"]["sensor"]
    sigma = dict(zip(record["parameters"], record["sigma"], strict=True))
    assert abs(sensor.gain_e_per_dn - GAIN) < 4.0 * sigma["gain_e_per_dn"] < 0.2 * GAIN
    assert abs(sensor.black_level_dn - BLACK) < 4.0 * sigma["black_level_dn"] + 1e-9
    assert abs(sensor.read_noise_e - READ) < 4.0 * sigma["read_noise_e"]
    assert record["levels"] == 5
    page = (tmp_path / "calibrate_sensor.html").read_text()
    assert page.count("data:image") == 4
    assert "photo response non-uniformity" in page
    assert "flat_8ms_1.jpg: is a JPEG" in result.output
    assert "1 images, the first bench.png, name no kind or no exposure" in result.output


def test_a_table_says_what_names_do_not(flats: Path) -> None:
    (flats / "exposures.csv").write_text("file,exposure_ms,lit\nbench.png,8,1\nflat_9ms_1.png,2.5,0\n")
    files, warnings = find_flat_frames(flats)
    assert [(file.path.name, file.exposure_s, file.is_lit) for file in files] == [
        ("bench.png", 0.008, True),
        ("flat_9ms_1.png", 0.0025, False),
    ]
    assert warnings == []
    (flats / "exposures.csv").write_text("file,exposure_ms,lit\ngone.png,8,1\n")
    with pytest.raises(
        ArctrackError, match=r"exposures.csv, line 2: file = 'gone.png': there is no such file"
    ):
        find_flat_frames(flats)


def test_what_is_missing_is_said_and_nothing_written(flats: Path, setup_toml: Path, tmp_path: Path) -> None:
    for path in (flats / "dark_1ms").iterdir():
        path.unlink()
    before = setup_toml.read_text()
    result = RUNNER.invoke(cli.app, ["calibrate", "sensor", str(flats), "--setup", str(setup_toml)])
    assert isinstance(result.exception, ArctrackError)
    assert "flats: there are no dark frames: cover the lens" in str(result.exception)
    assert setup_toml.read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flats", "recording.toml"]


def test_a_folder_of_other_things_is_refused_with_an_example(tmp_path: Path, setup_toml: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    result = RUNNER.invoke(cli.app, ["calibrate", "sensor", str(empty), "--setup", str(setup_toml)])
    assert "name them like flat_2.5ms_1.png" in str(result.exception)


def still_recording(path: Path, setup: Setup) -> Path:
    """Write a recording of a bright bar that stands still, and a dark frame."""
    draw = np.random.default_rng(1)
    y = np.arange(96.0)[:, np.newaxis]
    # A grain of a pixel, 1 sigma of ln 0.2.
    field = cv2.GaussianBlur(draw.standard_normal((96, 128)), (0, 0), 1.0) * 2.0 * np.sqrt(np.pi)
    light = 3500.0 * np.exp(-0.5 * ((y - 48.0) / 6.0) ** 2 + 0.2 * field)
    with RecordingWriter(path, setup) as writer:
        for n in range(25):
            charge = draw.poisson(light * (n > 0)) + draw.normal(0.0, READ, light.shape)
            image = np.clip(np.rint(BLACK + charge / GAIN), 0, 255).astype(np.uint8)
            writer.write_frame(Frame(n, 0.1 * n, image, 0.005, 0.0, laser_on=n > 0, arc_on=False))
            writer.write_pose(0.1 * n, np.eye(4))
    return path


@pytest.mark.slow
def test_a_still_recording_becomes_its_own_setup(tmp_path: Path) -> None:
    setup = nominal_setup("v_groove", "mild_steel", width=128, height=96)
    recording = still_recording(tmp_path / "still", setup)
    result = RUNNER.invoke(cli.app, ["calibrate", "sensor", str(recording)])
    assert result.exit_code == 0, result.output
    sensor = read_setup_file(recording / "recording.toml").setup.sensor
    record = tomllib.loads((recording / "recording.toml").read_text())["calibration"]["sensor"]
    sigma = dict(zip(record["parameters"], record["sigma"], strict=True))
    assert abs(sensor.gain_e_per_dn - GAIN) < 4.0 * sigma["gain_e_per_dn"] < 0.4 * GAIN
    assert abs(sensor.read_noise_e - READ) < 4.0 * sigma["read_noise_e"]
    assert record["frames"] == 24
    assert abs(record["speckle_contrast"] - 0.2) < 4.0 * record["speckle_contrast_sigma"]
    assert (recording / "recording.toml.1").exists()
    assert "speckle&#39;s contrast" in (recording / "calibrate_sensor.html").read_text()


def test_flat_frames_need_a_setup(flats: Path) -> None:
    result = RUNNER.invoke(cli.app, ["calibrate", "sensor", str(flats)])
    assert "flats: holds flat and dark frames: give --setup" in str(result.exception)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["gone"], "gone: there is no such folder; give a folder of frames, or a recording"),
        (["flats/bench.png"], "flats/bench.png: is a file; give a folder of frames, or a recording"),
        (
            ["flats", "--report", "recording.toml"],
            "recording.toml: is the setup's file; give --report another",
        ),
        (
            ["flats", "--report", "none/page.html"],
            "none: nothing can be written there; give --report another",
        ),
    ],
)
def test_places_that_cannot_be_are_refused(
    flats: Path, setup_toml: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], why: str
) -> None:
    monkeypatch.chdir(flats.parent)
    before = setup_toml.read_text()
    result = RUNNER.invoke(cli.app, ["calibrate", "sensor", *words, "--setup", str(setup_toml)])
    assert why in str(result.exception)
    assert setup_toml.read_text() == before


@pytest.mark.parametrize("option", ["--out", "--report"])
def test_a_recordings_own_files_are_not_replaced(tmp_path: Path, option: str) -> None:
    setup = nominal_setup("v_groove", "mild_steel", width=128, height=96)
    recording = still_recording(tmp_path / "still", setup)
    before = (recording / "poses.csv").read_text()
    result = RUNNER.invoke(
        cli.app, ["calibrate", "sensor", str(recording), option, str(recording / "poses.csv")]
    )
    assert f"poses.csv: is of the recording itself; give {option} another file" in str(result.exception)
    assert (recording / "poses.csv").read_text() == before


def test_a_comma_in_an_exposure_is_not_misread(flats: Path) -> None:
    (flats / "flat_6ms_0.tif").rename(flats / "flat_6,5ms_0.tif")
    files, warnings = find_flat_frames(flats)
    assert "flat_6,5ms_0.tif" not in [file.path.name for file in files]
    assert "2 images" in warnings[0]


def test_a_table_without_files_says_which_column_is_missing(flats: Path) -> None:
    (flats / "exposures.csv").write_text("exposure_ms,lit\n8,1\n")
    with pytest.raises(
        ArctrackError, match=r"line 1: the column file is missing; needed are file,exposure_ms"
    ):
        find_flat_frames(flats)


def test_a_frame_that_is_there_twice_is_refused() -> None:
    frame = draw_frame(2, np.random.default_rng(3))
    with pytest.raises(ValueError, match="2 ms: one of them is there twice, and a copy has no noise"):
        level_from([frame, frame.copy()], 0.002, is_lit=True, bits=8)
    saturated = np.full_like(frame, 255)
    assert level_from([saturated, saturated], 0.1, is_lit=True, bits=8).share_from(255.0) == 1.0


def test_frames_too_small_for_a_pattern_are_refused() -> None:
    with pytest.raises(ValueError, match="are of 8 x 9 px, 22 a side are needed"):
        level_from([np.zeros((9, 8), dtype=np.uint8)] * 2, 0.001, is_lit=True, bits=8)
