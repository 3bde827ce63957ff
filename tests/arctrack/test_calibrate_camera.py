import math
import runpy
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrate_commands import BOARD, EXAMPLES, command
from camera_scenes import BOARD as SCENE_BOARD
from camera_scenes import SIZE, VARIED, Held, picture_of, views

from arctrack.calibrate.camera.board_images import read_boards
from arctrack.calibrate.camera.stage import calibrated_camera
from arctrack.recording.setup_file import read_setup_file
from calibration.boards.board import Board
from calibration.camera.calibrate import fit_lens
from calibration.camera.enough import UndeterminedError
from calibration.camera.halves import Difference
from noise_model.compiled.arrays import UInt8

pytestmark = pytest.mark.slow

calibrate = command("camera")
PINHOLE = {"fx": 1000.0, "fy": 1003.0, "cx": 410.0, "cy": 290.0}


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of ten boards in several formats, and of five images that cannot be used."""
    folder = tmp_path_factory.mktemp("boards")
    pictures = [picture_of(held, PINHOLE) for held in VARIED]
    pictures[1] = 255 - pictures[1]
    pictures[2] = cv2.cvtColor(pictures[2], cv2.COLOR_GRAY2BGR)
    pictures[3] = pictures[3].astype(np.uint16) * 257
    pictures[4] = (20 + pictures[4] // 6).astype(np.uint8)
    for n, picture in enumerate(pictures):
        suffix = {5: "bmp", 6: "tiff"}.get(n, "png")
        cv2.imwrite(str(folder / f"board_{n}.{suffix}"), picture)
    shutil.copy(folder / "board_0.png", folder / "board_20.png")
    cv2.imwrite(str(folder / "board_21.png"), pictures[0][:500])
    cv2.imwrite(str(folder / "board_22.png"), np.full(SIZE[::-1], 90, dtype=np.uint8))
    (folder / "board_23.png").write_bytes((folder / "board_0.png").read_bytes()[:4000])
    cut = pictures[0].copy()
    cut[:, :330] = 200
    cv2.imwrite(str(folder / "board_24.png"), cut)
    return folder


def test_boards_become_a_setup_and_what_is_none_is_named(boards: Path, tmp_path: Path) -> None:
    setup = tmp_path / "recording.toml"
    setup.write_text((EXAMPLES / "v_groove" / "recording.toml").read_text() + "# mine\n")
    before = setup.read_text()
    result = calibrate(boards, *BOARD, "--setup", setup, "--distortion", "k1")
    assert result.exit_code == 0, result.output
    for line in (
        "10 of 15 images",
        "board_20.png: left out: shows the board where board_0.png shows it",
        "board_21.png: left out: is 800 x 500 px, most images are 800 x 600 px",
        "board_22.png: left out: is all of one grey level",
        "board_23.png: left out: is truncated",
        "board_24.png: left out: shows no whole board",
        "the one before is recording.toml.1",
    ):
        assert line in result.output
    assert (tmp_path / "recording.toml.1").read_text() == before
    assert "# mine" in setup.read_text()
    camera = read_setup_file(setup).setup.camera
    record = tomllib.loads(setup.read_text())["calibration"]["camera"]
    assert record["parameters"] == ["fx", "fy", "cx", "cy", "k1"]
    z = (np.array([camera.fx, camera.fy, camera.cx, camera.cy]) - [*PINHOLE.values()]) / record["sigma"][:4]
    assert np.abs(z).max() < 4.0
    page = (tmp_path / "calibrate_camera.html").read_text()
    assert "http://www.w3.org" not in page.replace("data:", "")
    assert "board_24.png" in page
    assert 'src="data:image' in page


def test_boards_that_do_not_tell_the_focal_length_are_refused(tmp_path: Path) -> None:
    for n in range(6):
        held = Held((0.35 + 0.06 * n, 0.5), 150.0 + 12.0 * n, about_z_deg=15.0 * n)
        cv2.imwrite(str(tmp_path / f"{n}.png"), picture_of(held, PINHOLE))
    result = calibrate(tmp_path, *BOARD)
    assert result.exit_code != 0
    assert "parallel to the sensor" in str(result.exception)


@pytest.mark.slow
@pytest.mark.parametrize(("order", "count"), [("none", 5), ("k1 k2", 5), ("rational", 8)])
def test_as_many_coefficients_are_written_as_opencv_takes(order: str, count: int) -> None:
    result = fit_lens(SCENE_BOARD, views(), SIZE, orders=[order])
    values = calibrated_camera(result).values
    assert values["distortion"] == pytest.approx(result.scene.lens.distortion[:count], rel=1e-8)
    assert not result.scene.lens.distortion[count:].any()


def test_a_wrong_count_of_corners_is_hinted_at(boards: Path, tmp_path: Path) -> None:
    shutil.copy(boards / "board_0.png", tmp_path)
    result = calibrate(tmp_path, "--board", "chessboard:8x7:10mm")
    assert "chessboard:7x6:10mm is seen: inner corners are counted, not squares" in str(result.exception)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--board", "9x6"], "--board: '9x6' is no board: it is written as chessboard:"),
        ([*BOARD, "--out", "x.toml"], "--out: needs --setup"),
        ([*BOARD, "--distortion", "k7"], "--distortion k7: must be auto, none, k1"),
        (["--board", "charuco:11x10:9mm:6mm:4X4_50"], "such a board has 55 markers, DICT_4X4_50 holds 50"),
    ],
)
def test_wrong_options_are_refused(boards: Path, words: list[str], why: str) -> None:
    result = calibrate(boards, *words)
    assert result.exit_code != 0
    assert why in str(result.exception)


def test_an_unknown_that_no_image_shows_is_a_line_of_error(
    boards: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A half of the images may leave open what all of them tell."""

    def leave_open(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("an unknown is not seen at all")

    monkeypatch.setattr("arctrack.calibrate.camera.stage.calibrate_camera", leave_open)
    result = calibrate(boards, *BOARD)
    assert result.exit_code != 0
    assert "leave a value of the lens open: add images of the board tilted" in str(result.exception)


def test_a_page_does_not_replace_the_setup(boards: Path, tmp_path: Path) -> None:
    setup = tmp_path / "recording.toml"
    setup.write_text((EXAMPLES / "v_groove" / "recording.toml").read_text())
    before = setup.read_text()
    result = calibrate(boards, *BOARD, "--setup", setup, "--report", setup)
    assert "recording.toml: is the setup's file; give --report another one" in str(result.exception)
    assert setup.read_text() == before


def test_twelve_bits_in_sixteen_are_not_dim(tmp_path: Path) -> None:
    picture = picture_of(VARIED[0], PINHOLE).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "board.png"), picture * 16)
    assert not read_boards([tmp_path], Board.parse(BOARD[1])).is_dim


def test_a_distortion_that_few_boards_do_not_tell_is_refused() -> None:
    with pytest.raises(UndeterminedError, match="the distortion rational leaves the image unknown to more"):
        fit_lens(SCENE_BOARD, views(sigma_px=0.3), SIZE, orders=["rational"])


def test_halves_that_know_nothing_do_not_blame_the_board() -> None:
    result = fit_lens(SCENE_BOARD, views(), SIZE, orders=["k1"])
    points = np.zeros((1, 2))
    unknown = Difference(points, points, np.array([math.nan]))
    error = replace(result, halves=[unknown]).model_error
    assert error is not None
    assert "half of the images does not tell the distortion k1" in error


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> list[UInt8]:
    """Return the pictures that the example draws: fx 2186, fy 2190 px and k1 -0.35."""
    folder = tmp_path_factory.mktemp("shipped")
    runpy.run_path(str(EXAMPLES / "make_boards.py"))["main"](folder)
    return [read_grey(path) for path in sorted(folder.glob("*.png"))]


def read_grey(path: Path) -> UInt8:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), dtype=np.uint8)


@pytest.mark.parametrize(
    ("factor", "way", "suffix", "noise_dn"),
    [
        (0.4, cv2.INTER_AREA, "png", 0.0),
        (0.5, cv2.INTER_LANCZOS4, "png", 0.0),
        (0.5, cv2.INTER_LANCZOS4, "jpg", 0.0),
        (0.6, cv2.INTER_LINEAR, "png", 5.0),
        (1.0, cv2.INTER_NEAREST, "jpg", 0.0),
        (2.0, cv2.INTER_LINEAR, "png", 0.0),
    ],
)
def test_the_lens_is_the_same_at_every_size_of_the_images(
    shipped: list[UInt8], tmp_path: Path, factor: float, way: int, suffix: str, noise_dn: float
) -> None:
    rng = np.random.default_rng(1)
    for n, picture in enumerate(shipped):
        resized = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=way)
        resized = (resized + noise_dn * rng.standard_normal(resized.shape)).clip(0, 255).round()
        cv2.imwrite(str(tmp_path / f"{n}.{suffix}"), resized, [cv2.IMWRITE_JPEG_QUALITY, 75])
    board = Board.parse("chessboard:9x6:4mm")
    images = read_boards([tmp_path], board)
    result = fit_lens(board, images.views, images.size)
    lens = result.scene.lens
    found = dict(zip(lens.names, zip(lens.values, result.sigma[:-2], strict=True), strict=True))
    assert result.order == "k1"
    for name, truth in (("fx", 2186.0 * factor), ("fy", 2190.0 * factor), ("k1", -0.35)):
        value, sigma = found[name]
        assert abs(value - truth) < 3.0 * sigma, name
    assert found["k1"][0] == pytest.approx(-0.355, abs=0.02)
    assert bool(images.warnings) == (suffix == "jpg")


def test_boards_of_a_few_pixels_are_refused_with_the_cure(shipped: list[UInt8], tmp_path: Path) -> None:
    for n, picture in enumerate(shipped[:2]):
        small = cv2.resize(picture, None, fx=0.13, fy=0.13, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / f"{n}.png"), small)
    result = calibrate(tmp_path, "--board", "chessboard:9x6:4mm")
    assert "px apart, more than 4 are needed: give the images at the camera's own size" in str(
        result.exception
    )


def test_help_has_an_example() -> None:
    result = calibrate("--help")
    assert "Example: arctrack calibrate camera /tmp/boards --board chessboard:9x6:4mm" in result.output
