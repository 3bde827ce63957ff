import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrate_commands import BOARD, EXAMPLES, command, setup_with_camera
from camera_scenes import BOARD as BOARD_SHOWN
from camera_scenes import picture
from click.testing import Result
from hand_eye_scenes import HELD, T_HOLDER_CAMERA, TRUE_LENS, board_in_camera, off, shown
from scipy.spatial.transform import Rotation

from arctrack.calibrate.hand_eye.stage import LOOKS_UP, hand_eye_record
from arctrack.recording import read_setup_file, with_calibrated
from calibration.camera.known_lens import board_poses
from calibration.hand_eye_boards.calibrate import calibrate_hand_eye
from noise_model.compiled.arrays import Float64

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


def test_poses_of_a_flange_with_z_into_the_part_need_the_tool(
    images: Path, setup_toml: Path, tmp_path: Path
) -> None:
    T_tool_flange = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tool_flange[2, 3] = 200.0
    path = write(tmp_path / "poses.csv", poses() @ T_tool_flange)
    words = (images, *BOARD, "--poses", path, "--rotation", "kuka", "--setup", setup_toml)
    assert refusal(calibrate(*words)) == f"{path}: {LOOKS_UP}"
    with setup_toml.open("a") as file:
        file.write("\n[robot.controllertool_to_tool]\ntranslation_mm = [0.0, 0.0, 200.0]\n")
        file.write("quaternion_xyzw = [1.0, 0.0, 0.0, 0.0]\n")
    result = calibrate(*words)
    assert result.exit_code == 0, result.output
    camera = read_setup_file(setup_toml).setup.camera
    assert np.abs(off(camera.T_tool_camera)[3:]).max() < 1.0


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


CARRIED = "the robot carries the camera, 150 mm from its tool, and the board stands still, 775 mm from base"
STILL = "the camera stands still, 150 mm from base's origin, and the robot carries the board, 775 mm from its"


def refusal(result: Result) -> str:
    assert result.exit_code != 0
    return str(result.exception)


@pytest.mark.parametrize("is_inverted", [False, True], ids=["still", "inverted"])
def test_inverted_poses_and_a_camera_that_stands_still_are_both_named(
    is_inverted: bool, images: Path, setup_toml: Path, tmp_path: Path
) -> None:
    """Either has the other's equation, so either's camera must not be taken for the only one."""
    T_base_tool = np.linalg.inv(poses()) if is_inverted else poses(is_eye_to_hand=True)
    path = write(tmp_path / "poses.csv", T_base_tool)
    words = (images, *BOARD, "--poses", path, "--rotation", "kuka", "--setup", setup_toml)
    cure = refusal(calibrate(*words))
    assert f"--eye-to-hand, if the file's poses are the tool in base, {STILL}" in cure
    assert (
        f"each pose of the file inverted, if the file's poses are base in the tool (inverted), {CARRIED}"
        in cure
    )
    assert "the images cannot tell the two apart" in cure
    followed = calibrate(*words, "--eye-to-hand")
    assert followed.exit_code == 0
    said = " ".join(followed.output.split())
    assert f"This holds if the file's poses are the tool in base, {STILL}" in said
    assert f"fit if the file's poses are base in the tool (inverted), {CARRIED}" in said
    write(path, np.linalg.inv(T_base_tool))
    assert calibrate(*words).exit_code == 0


def transposed(T_base_tool: Float64) -> Float64:
    result = T_base_tool.copy()
    result[:, :3, :3] = T_base_tool[:, :3, :3].swapaxes(1, 2)
    return result


def of_another_length(T_base_tool: Float64, mm: float) -> Float64:
    result = T_base_tool.copy()
    result[:, :3, 3] /= mm
    return result


@pytest.mark.parametrize(
    ("change", "reading"),
    [
        (transposed, "each rotation of the file transposed"),
        (
            lambda T: np.diag([1.0, 1.0, -1.0, 1.0]) @ T @ np.diag([1.0, 1.0, -1.0, 1.0]),
            "one axis of base and tool mirrored (the file's are left-handed)",
        ),
        (lambda T: of_another_length(T, 1000.0), "positions in m"),
        (
            lambda T: of_another_length(T, 25.4),
            "positions in inches, which arctrack does not read: convert them",
        ),
        (
            lambda T: of_another_length(transposed(T), 1000.0),
            "each rotation of the file transposed and positions in m",
        ),
    ],
    ids=["transposed", "left-handed", "metres", "inches", "transposed metres"],
)
def test_a_reading_that_fits_is_named(
    change: Callable[[Float64], Float64], reading: str, images: Path, setup_toml: Path, tmp_path: Path
) -> None:
    path = write(tmp_path / "poses.csv", change(poses()))
    result = calibrate(images, *BOARD, "--poses", path, "--rotation", "kuka", "--setup", setup_toml)
    assert refusal(result).endswith(f"if they are read otherwise: {reading}")


@pytest.mark.parametrize(
    ("header", "words", "cure"),
    [
        (
            "w_deg,p_deg,r_deg",
            ("fanuc",),
            "--rotation kuka --column a=w_deg --column b=p_deg --column c=r_deg",
        ),
        (
            "a_deg,b_deg,c_deg",
            ("XYZ", *("--column", "rx=a_deg"), *("--column", "ry=b_deg", "--column", "rz=c_deg")),
            "",
        ),
    ],
    ids=["by other names", "by its names"],
)
def test_another_convention_that_fits_is_named_with_what_reads_it(
    header: str, words: tuple[str, ...], cure: str, images: Path, setup_toml: Path, tmp_path: Path
) -> None:
    path = write(tmp_path / "poses.csv", poses(), header)
    given = (images, *BOARD, "--poses", path, "--setup", setup_toml, "--rotation")
    said = refusal(calibrate(*given, *words))
    cure = cure or "--rotation kuka without --column rx without --column ry without --column rz"
    assert said.startswith(f"{path}: ")
    assert said.endswith(f"if they are read otherwise: {cure}")
    assert not (tmp_path / "calibrate_hand_eye.html").exists()
    followed = cure.partition(" without")[0].split()[1:]
    assert calibrate(*given, *followed).exit_code == 0


def test_angles_in_radians_and_a_quaternions_order_are_told(
    images: Path, setup_toml: Path, tmp_path: Path
) -> None:
    turns = [Rotation.from_matrix(T[:3, :3]) for T in poses()]
    path = tmp_path / "poses.csv"
    for header, numbers, words, reading in (
        ("a_deg,b_deg,c_deg", [turn.as_euler("ZYX") for turn in turns], ("--rotation", "kuka"), "in rad"),
        (
            "qx,qy,qz,qw",
            [turn.as_quat()[[3, 0, 1, 2]] for turn in turns],
            (),
            "--rotation wxyz --column qw=qx --column qx=qy --column qy=qz --column qz=qw",
        ),
    ):
        rows = [
            f"board_{n}.png,{','.join(f'{each:.7f}' for each in (*T[:3, 3], *number))}"
            for n, (T, number) in enumerate(zip(poses(), numbers, strict=True))
        ]
        path.write_text("\n".join([f"file,x_mm,y_mm,z_mm,{header}", *rows]) + "\n")
        given = (images, *BOARD, "--poses", path, "--setup", setup_toml)
        assert refusal(calibrate(*given, *words)).endswith(reading)
    assert calibrate(*given, *reading.split()).exit_code == 0


def test_matrices_column_by_column_are_read_and_told(images: Path, setup_toml: Path, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    np.savetxt(path, poses().swapaxes(1, 2).reshape(-1, 16))
    words = ("--poses", path, "--rotation", "matrix", "--units", "mm")
    result = calibrate(images, *BOARD, *words, "--setup", setup_toml)
    assert result.exit_code == 0
    assert "the matrices stand column by column, and are read so" in result.output
    sigma = np.sqrt(np.diag(tomllib.loads(setup_toml.read_text())["calibration"]["hand_eye"]["covariance"]))
    assert np.abs(off(read_setup_file(setup_toml).setup.camera.T_tool_camera) / sigma).max() < 4.0


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
