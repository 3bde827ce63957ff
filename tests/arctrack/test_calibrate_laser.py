import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrate_commands import BOARD, EXAMPLES, command, setup_with_camera
from laser_scenes import BOARDS, PINHOLE, PLANE, SIZE, pictures

from arctrack.recording import read_setup_file

pytestmark = pytest.mark.slow

calibrate = command("laser")


@pytest.fixture
def setup_toml(tmp_path: Path) -> Path:
    return setup_with_camera(tmp_path, SIZE, PINHOLE)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of five pairs, one without a stripe, and three images without a partner."""
    folder = tmp_path_factory.mktemp("pairs")
    for n, held in enumerate(BOARDS):
        off, on = pictures(held, seed=n, flicker=1.0 + 0.02 * n)
        cv2.imwrite(str(folder / f"board_{n}.png"), off)
        cv2.imwrite(str(folder / f"laser_{n}.png"), cv2.cvtColor(on, cv2.COLOR_GRAY2BGR))
    dark = pictures(BOARDS[1], seed=9, with_laser=False)
    shifted = [np.roll(picture, 20, axis=1) for picture in dark]
    cv2.imwrite(str(folder / "board_8.png"), shifted[0])
    cv2.imwrite(str(folder / "laser_8.png"), shifted[1])
    cv2.imwrite(str(folder / "board_9.png"), shifted[0])
    lit = pictures(replace(BOARDS[1], depth_mm=185.0), seed=11)[1]
    cv2.imwrite(str(folder / "laser_6.png"), lit)
    cv2.imwrite(str(folder / "laser_7.png"), np.full_like(lit, 30))
    return folder


def test_pairs_become_a_sheet_in_the_setup(pairs: Path, setup_toml: Path, tmp_path: Path) -> None:
    before = setup_toml.read_text()
    result = calibrate(pairs, *BOARD, "--setup", setup_toml)
    assert result.exit_code == 0, result.output
    for line in (
        "board_9.png: left out: has no image with the laser",
        "laser_8.png: left out: shows no stripe on the board",
        "laser_7.png: left out: is all of one grey level; and it has no image without the laser",
        "6 pairs",
        "1 images show board and stripe at once",
        "on both sides no pair shows where the stripe ends, which is beyond the board's edge",
        "the one before is recording.toml.1",
    ):
        assert line in result.output
    assert (tmp_path / "recording.toml.1").read_text() == before
    assert "# mine" in setup_toml.read_text()
    setup = read_setup_file(setup_toml).setup
    record = tomllib.loads(setup_toml.read_text())["calibration"]["laser"]
    assert record["parameters"] == ["n_x", "n_y", "n_z", "d_mm", "stripe_sigma_mm"]
    T = setup.camera.T_tool_camera
    truth = np.array([*(T[:3, :3] @ PLANE[:3]), PLANE[3] - T[:3, 3] @ T[:3, :3] @ PLANE[:3]])
    truth *= np.sign(truth[:3] @ setup.laser.plane[:3])
    assert np.abs((setup.laser.plane - truth) / record["sigma"][:4]).max() < 4.0
    assert max(record["sigma"][:3]) < 1e-3
    off_mm = setup.laser.origin_mm @ setup.laser.plane[:3] + setup.laser.plane[3]
    assert off_mm == pytest.approx(0.0, abs=1e-3)
    page = (tmp_path / "calibrate_laser.html").read_text()
    assert 'src="data:image' in page
    assert "laser_8.png: shows no stripe" in page
    assert "the lens counts as exact" not in page


def test_two_pairs_are_not_enough(pairs: Path, setup_toml: Path) -> None:
    files = [pairs / f"{half}_{n}.png" for half in ("board", "laser") for n in "01"]
    result = calibrate(*files, *BOARD, "--setup", setup_toml)
    assert "2 pairs show board and stripe: 3 at least are needed" in str(result.exception)


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["a_1.png", "b_1.png"], "has the number of a_1.png, and both are of one kind"),
        (["off_1.png", "laser_off_2.png"], "holds no pair of images without and with the laser: pairs share"),
        (["off_1.png", "on_1.png"], "[camera] width, height: 640 x 480, but the images are 800 x 600 px"),
    ],
)
def test_files_that_are_no_pairs_are_named(pairs: Path, tmp_path: Path, names: list[str], why: str) -> None:
    for name in names:
        shutil.copy(pairs / "board_0.png", tmp_path / name)
    out = tmp_path / "out.toml"
    result = calibrate(tmp_path, *BOARD, "--setup", EXAMPLES / "v_groove", "--out", out)
    assert why in str(result.exception)
    assert not out.exists()


def test_a_covariance_of_other_rows_than_parameters_is_named(pairs: Path, setup_toml: Path) -> None:
    text = setup_toml.read_text()
    setup_toml.write_text(text.replace('parameters = ["fx", ', 'parameters = ["fx", "k1", '))
    result = calibrate(pairs, *BOARD, "--setup", setup_toml)
    assert "[calibration.camera] covariance: must have 5 rows of 5 numbers" in str(result.exception)


@pytest.mark.parametrize("option", ["--out", "--report"])
def test_no_image_is_replaced(pairs: Path, setup_toml: Path, option: str) -> None:
    result = calibrate(pairs, *BOARD, "--setup", setup_toml, option, pairs / "laser_1.png")
    assert f"laser_1.png: is one of the images; give {option} another file" in str(result.exception)


def test_help_has_an_example() -> None:
    result = calibrate("--help")
    assert "Example: arctrack calibrate laser /tmp/pairs --board chessboard:8x6:2.5mm" in result.output
