import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrate_commands import BOARD, EXAMPLES, command, setup_with_camera
from camera_scenes import BOARD as BOARD_SHOWN
from camera_scenes import picture
from hand_eye_scenes import HELD, T_HOLDER_CAMERA, TRUE_LENS, board_in_camera, off, shown
from scipy.spatial.transform import Rotation

from arctrack.calibration_records.hand_eye_record import hand_eye_record
from arctrack.recording import read_setup_file, with_calibrated
from calibration.camera.known_lens import board_poses
from calibration.hand_eye_boards.calibrate import calibrate_hand_eye
from noise_model.arrays import Float64

pytestmark = pytest.mark.slow

calibrate = command("hand-eye")
POSES = ("--poses", "{images}/poses.csv", "--rotation", "kuka")
SHOWN = HELD[:6]
SIZE, PINHOLE = (400, 300), {"fx": 500.0, "fy": 501.5, "cx": 205.0, "cy": 145.0}


@pytest.fixture
def setup_toml(tmp_path: Path) -> Path:
    return setup_with_camera(tmp_path, SIZE, PINHOLE)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of pictures of a board, and poses.csv with the robot's, in KUKA's angles."""
    folder = tmp_path_factory.mktemp("boards")
    matrix = np.array([[PINHOLE["fx"], 0.0, PINHOLE["cx"]], [0.0, PINHOLE["fy"], PINHOLE["cy"]], [0, 0, 1]])
    for n, held in enumerate(SHOWN):
        T = board_in_camera(held)
        cv2.imwrite(str(folder / f"board_{n}.png"), picture(matrix @ T[:3, [0, 1, 3]], SIZE, seed=n))
    write(folder / "poses.csv", poses())
    return folder


def poses(*, is_eye_to_hand: bool = False) -> Float64:
    boards = [board_in_camera(held) for held in SHOWN]
    return shown(boards, is_eye_to_hand=is_eye_to_hand, noise=0.5).T_base_tool


def write(path: Path, T_base_tool: Float64, angles: str = "a_deg,b_deg,c_deg") -> Path:
    rows = [f"file,x_mm,y_mm,z_mm,{angles}"]
    for n, T in enumerate(T_base_tool):
        turns = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
        rows.append(",".join([f"board_{n}.png", *(f"{number:.5f}" for number in (*T[:3, 3], *turns))]))
    path.write_text("\n".join(rows) + "\n")
    return path


def test_boards_and_poses_become_a_camera(images: Path, setup_toml: Path, tmp_path: Path) -> None:
    before = setup_toml.read_text()
    lacking = tmp_path / "poses.csv"
    lacking.write_text("\n".join((images / "poses.csv").read_text().splitlines()[:-1]) + "\n")
    result = calibrate(images, *BOARD, "--poses", lacking, "--rotation", "kuka", "--setup", setup_toml)
    assert result.exit_code == 0, result.output
    for line in (
        "board_5.png: left out: has no pose in poses.csv",
        "5 of 6 images and poses are used",
        "robot's place, each axis",
        "the one before is recording.toml.1",
    ):
        assert line in result.output
    assert (tmp_path / "recording.toml.1").read_text() == before
    assert "# mine" in setup_toml.read_text()
    record = tomllib.loads(setup_toml.read_text())["calibration"]["hand_eye"]
    assert record["parameters"][0] == "rot_x_deg"
    assert record["lens_parameters"] == list(PINHOLE)
    assert len(record["move_z_mm_per_lens"]) == len(PINHOLE)
    sigma = np.sqrt(np.diag(record["covariance"]))
    camera = read_setup_file(setup_toml).setup.camera
    assert np.abs(off(camera.T_tool_camera) / sigma).max() < 4.0
    assert sigma[3:].max() < 0.3
    page = (tmp_path / "calibrate_hand_eye.html").read_text()
    assert page.count('src="data:image') == 4
    assert "board_5.png: has no pose" in page
    assert "the lens counts as exact" not in page


def test_a_camera_that_stands_still_is_kept_apart(setup_toml: Path) -> None:
    stated = read_setup_file(setup_toml).setup.camera.T_tool_camera
    seen = shown(is_eye_to_hand=True)
    result = calibrate_hand_eye(
        *board_poses(BOARD_SHOWN, seen.views, TRUE_LENS), seen.T_base_tool, is_eye_to_hand=True
    )
    setup_toml.write_text(with_calibrated(setup_toml, hand_eye_record(result)))
    record = tomllib.loads(setup_toml.read_text())["calibration"]["camera_in_base"]
    sigma = np.sqrt(np.diag(record["covariance"]))[3:]
    place = T_HOLDER_CAMERA[:3, :3].T @ (np.array(record["translation_mm"]) - T_HOLDER_CAMERA[:3, 3])
    assert np.abs(place / sigma).max() < 4.0
    assert np.array_equal(read_setup_file(setup_toml).setup.camera.T_tool_camera, stated)


def test_a_camera_that_stands_still_is_told(images: Path, setup_toml: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "poses.csv", poses(is_eye_to_hand=True))
    result = calibrate(images, *BOARD, "--poses", path, "--rotation", "kuka", "--setup", setup_toml)
    assert "the poses fit the boards if they are read otherwise: --eye-to-hand" in str(result.exception)


def test_another_convention_that_fits_is_named(images: Path, setup_toml: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "poses.csv", poses(), "w_deg,p_deg,r_deg")
    result = calibrate(images, *BOARD, "--poses", path, "--rotation", "fanuc", "--setup", setup_toml)
    assert str(result.exception).startswith(f"{path}: ")
    assert str(result.exception).endswith("if they are read otherwise: --rotation kuka")
    assert not (tmp_path / "calibrate_hand_eye.html").exists()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--rotation", "kuka"), "--rotation: has no effect without --board; state the board, or leave it"),
        (("--eye-to-hand",), "--eye-to-hand: has no effect without --board"),
        ((), "--out: give the file to write the setup with the pose found to"),
        (BOARD, "--poses: give the robot's pose of each image"),
        ((*BOARD, "--poses", "poses.csv"), "--setup: give the recording.toml whose camera took the images"),
        (
            (*BOARD, *POSES, "--setup", "{examples}/v_groove", "--report", "{images}/poses.csv"),
            "poses.csv: holds the robot's poses; give --report another file",
        ),
        (
            (*BOARD, *POSES[:2], "--setup", "{examples}/v_groove"),
            "no columns are called qx, qy, qz, qw: say by --rotation how it is written",
        ),
        (
            (*BOARD, *POSES, "--setup", "{examples}/v_groove"),
            "[camera] width, height: 640 x 480, but the images are 400 x 300 px",
        ),
    ],
)
def test_what_is_missing_is_said(images: Path, tmp_path: Path, words: tuple[str, ...], line: str) -> None:
    filled = [word.format(images=images, examples=EXAMPLES) for word in words]
    out = ["--out", str(tmp_path / "out.toml")] if "--setup" in words else []
    result = calibrate(images, *filled, *out)
    assert line in str(result.exception)
    assert not (tmp_path / "out.toml").exists()


def test_help_has_an_example_of_either_way() -> None:
    output = " ".join(calibrate("--help").output.split())
    assert "Example: arctrack calibrate hand-eye /tmp/hand_eye --board chessboard:9x6:4mm" in output
    assert "Example: arctrack calibrate hand-eye examples/v_groove --out /tmp/found.toml" in output
