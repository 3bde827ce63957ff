"""Lenses of other programs' files: as their documentation writes them, there and back, and refused."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibrate_commands import EXAMPLES, command, copied_setup
from hypothesis import given
from hypothesis import strategies as st

from arctrack.calibrate.exchange.lens_file import LensFile
from arctrack.calibrate.exchange.read_lens import read_lens
from arctrack.calibrate.exchange.write_lens import WRITERS
from arctrack.errors import ArctrackError
from arctrack.recording import read_setup_file
from noise_model.compiled.arrays import Float64
from noise_model.instrument.camera import Camera

import_lens, export_lens = command("import"), command("export")

MRCAL = """# generated with mrcal-calibrate-cameras
{
    'lensmodel':  'LENSMODEL_OPENCV5',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1761.181055, 1761.250444, 1965.706996, 1087.518797,
        -0.01266096516, 0.03590794372, -0.0002547045941, 0.0005275929652, 0.01968883397,],

    # extrinsics are rt_fromref
    'extrinsics': [ 0.1, 0, 0, -0, -0, -0.5,],

    'imagersize': [ 4000, 2200,],
    'optimization_inputs': b'0W8%IVjT|',
}
"""
"""After analyses/synthetic_data/2019-01/reference.opencv5.cameramodel of dkogan/mrcal."""

KALIBR = """cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  T_cam_imu:
  - [0.01779318, 0.99967549,-0.01822936, 0.07008565]
  - [-0.9998017, 0.01795239, 0.00860714,-0.01771023]
  - [0.00893160, 0.01807260, 0.99979678, 0.00399246]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: -8.121e-05
  rostopic: /cam0/image_raw
  resolution: [752, 480]
cam1:
  camera_model: omni
  intrinsics: [0.80065662, 833.006, 830.345, 373.850, 253.749]
  distortion_model: radtan
  distortion_coeffs: [-0.33518750, 0.13211436, 0.00055967, 0.00057686]
  resolution: [752, 480]
"""
"""The example of Kalibr's wiki, https://github.com/ethz-asl/kalibr/wiki/yaml-formats."""

ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [ 500.5, 0, 320.25,
          0, 501.5, 240.75, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.36, 0.2, 1e-05, -4.5e-4, 0]
"""
"""A file of camera_calibration_parsers."""

CAMERA_INFO = """header:
  stamp: {sec: 1, nanosec: 2}
  frame_id: camera
height: 1024
width: 1280
distortion_model: rational_polynomial
d:
- 0.1
- 0.2
- 0.001
- 0.002
- 0.3
- 0.4
- 0.5
- 0.6
k: [2000.0, 0.0, 639.5, 0.0, 2004.0, 511.5, 0.0, 0.0, 1.0]
binning_x: 2
binning_y: 2
roi: {x_offset: 320, y_offset: 256, height: 512, width: 640, do_rectify: false}
---
height: 1
width: 1
"""
"""A message of sensor_msgs/CameraInfo as `ros2 topic echo` prints it."""

HALCON = """# INTERNAL CAMERA PARAMETERS

ParGroup: Camera: Parameter;
    "Internal camera parameters";

Focus:foc: 0.00806039;
    DOUBLE:0.0:;
    "Focal length of the lens [meter]";

Kappa:kappa: -2253.5;
    DOUBLE::;
    "Radial distortion coefficient [1/(meter*meter)]";

Sx:sx: 1.0629e-05;
    DOUBLE:0.0:;
    "Width of a cell on the sensor [meter]";

Sy:sy: 1.1e-05;
    DOUBLE:0.0:;
    "Height of a cell on the sensor [meter]";

Cx:cx: 378.236;
    DOUBLE:0.0:;
    "X-coordinate of the image center [pixel]";

Cy:cy: 297.587;
    DOUBLE:0.0:;
    "Y-coordinate of the image center [pixel]";

ImageWidth:imgw: 768;
    INT:1:32767;
    "Width of the images [pixel]";

ImageHeight:imgh: 576;
    INT:1:32767;
    "Height of the images [pixel]";
"""
"""The example of `read_cam_par`, https://www.mvtec.com/doc/halcon/12/en/read_cam_par.html."""

POLYNOMIAL = "".join(
    f"Poly{n}:poly{n}: {value};\n" for n, value in enumerate((1500.0, -2e7, 0, 0.03, -0.02), 1)
)


def read(text: str, folder: Path, camera: str | None = None) -> LensFile:
    path = folder / "lens"
    path.write_text(text)
    return read_lens(path, camera)


def test_mrcals_own_file(tmp_path: Path) -> None:
    lens = read(MRCAL, tmp_path)
    assert lens.pinhole == (1761.181055, 1761.250444, 1965.706996, 1087.518797)
    assert lens.distortion == (
        -0.01266096516,
        0.03590794372,
        -0.0002547045941,
        0.0005275929652,
        0.01968883397,
    )
    assert lens.size == (4000, 2200)


def test_kalibrs_own_example_names_its_cameras_and_keeps_no_pose(tmp_path: Path) -> None:
    lens = read(KALIBR, tmp_path, "cam0")
    assert lens.pinhole == (461.629, 460.152, 362.680, 246.049)
    assert lens.values["distortion"] == [-0.27695497, 0.06712482, 0.00087538, 0.00011556, 0.0]
    assert lens.not_taken == ("T_cam_imu", "timeshift_cam_imu")
    with pytest.raises(ArctrackError, match="holds the cameras cam0, cam1: give one as --camera"):
        read(KALIBR, tmp_path)
    with pytest.raises(ArctrackError, match="cam1: camera_model = 'omni': only pinhole"):
        read(KALIBR, tmp_path, "cam1")


def test_ros_calibration_file(tmp_path: Path) -> None:
    lens = read(ROS, tmp_path)
    assert lens.pinhole == (500.5, 501.5, 320.25, 240.75)
    assert lens.distortion == (-0.36, 0.2, 1e-05, -4.5e-4, 0.0)
    assert lens.size == (640, 480)


def test_camera_info_is_that_of_the_image_as_it_was_read_out(tmp_path: Path) -> None:
    lens = read(CAMERA_INFO, tmp_path)
    assert lens.size == (320, 256)
    # The sensor's px 639 and 640 are combined into 159.5 = (639.5 - 320 - 0.5) / 2 of the region's.
    assert lens.pinhole == (1000.0, 1002.0, 159.5, 127.5)
    assert lens.distortion == (0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
@pytest.mark.parametrize(
    "names",
    [
        ("camera_matrix", "distortion_coefficients"),
        ("Camera_Matrix", "Distortion_Coefficients"),
        ("M1", "D1"),
        ("cameraMatrix", "distCoeffs"),
    ],
)
def test_what_opencv_wrote(names: tuple[str, str], suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"out_camera_data.{suffix}"
    matrix = np.array([[657.46, 0.0, 319.5], [0.0, 658.1, 239.5], [0.0, 0.0, 1.0]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 30 Nov")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write(names[0], matrix)
    storage.write(names[1], np.array([[-0.41], [0.6], [0.001], [-0.002], [-1.3]]))
    storage.release()
    lens = read_lens(path, None)
    assert lens.pinhole == (657.46, 658.1, 319.5, 239.5)
    assert lens.distortion == (-0.41, 0.6, 0.001, -0.002, -1.3)
    assert lens.size == (640, 480)


def grid(lens: LensFile) -> Float64:
    """Return points of the image (N, 2), px."""
    assert lens.size is not None
    sides = [np.linspace(0.0, side - 1.0, 9) for side in lens.size]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("name", ["Kappa", "Poly"])
def test_halcons_rays_are_seen_where_halcon_sees_them(name: str, tmp_path: Path) -> None:
    text = HALCON if name == "Kappa" else HALCON.replace("Kappa:kappa: -2253.5;", POLYNOMIAL)
    lens = read(text, tmp_path)
    px = grid(lens)
    u, v = ((px - [378.236, 297.587]) * [1.0629e-05, 1.1e-05]).T
    r2 = u**2 + v**2
    if name == "Kappa":
        x, y = u / (1.0 - 2253.5 * r2), v / (1.0 - 2253.5 * r2)
    else:
        radial = 1.0 + 1500.0 * r2 - 2e7 * r2**2
        x = u * radial + 0.03 * (r2 + 2.0 * u**2) - 2.0 * 0.02 * u * v
        y = v * radial - 0.02 * (r2 + 2.0 * v**2) + 2.0 * 0.03 * u * v
    rays = np.column_stack([x, y, np.full(len(x), 0.00806039)])
    off_px = np.linalg.norm(lens.lens.project(rays) - px, axis=1).max()
    assert lens.pinhole[:2] == pytest.approx((758.339, 732.763), abs=1e-3)
    assert off_px <= 1.1 * lens.error_px + 1e-9
    assert lens.error_px < (1e-6 if name == "Kappa" else 0.05)


@pytest.mark.parametrize("program", ["Kalibr", "OpenCV", "ROS"])
def test_a_fisheye_is_fitted_where_a_pinhole_sees_the_same(program: str, tmp_path: Path) -> None:
    D = (-0.01, 0.005, -0.002, 0.0005)
    text = {
        "Kalibr": "cam0: {camera_model: pinhole, intrinsics: [600, 601, 376, 240], resolution: [752, 480], "
        f"distortion_model: equidistant, distortion_coeffs: {[*D]}}}",
        "ROS": "{width: 752, height: 480, K: [600, 0, 376, 0, 601, 240, 0, 0, 1], "
        f"distortion_model: equidistant, D: {[*D]}}}",
        "OpenCV": "image_width: 752\nimage_height: 480\nfisheye_model: 1\n"
        f"camera_matrix: [[600, 0, 376], [0, 601, 240], [0, 0, 1]]\ndistortion_coefficients: {[*D]}",
    }[program]
    lens = read(text, tmp_path)
    rays = np.array([[0.3, 0.2, 1.0], [-0.5, 0.1, 1.0], [0.0, -0.35, 1.0]])
    right, _ = cv2.fisheye.projectPoints(
        rays[:, None],
        np.zeros(3),
        np.zeros(3),
        np.array([[600.0, 0, 376], [0, 601, 240], [0, 0, 1]]),
        np.array(D),
    )
    assert lens.lens.project(rays) == pytest.approx(right[:, 0], abs=1e-3)
    assert 0.0 < lens.error_px < 1e-3


NUMBER = st.floats(-10.0, 10.0, allow_subnormal=False)
FOCAL = st.floats(500.0, 900.0)


@pytest.mark.parametrize(("program", "counts"), [("mrcal", (5, 8, 14)), ("kalibr", (4,)), ("ros", (5, 8))])
@given(st.data())
def test_a_lens_comes_back_to_the_last_digit(
    tmp_path_factory: pytest.TempPathFactory, program: str, counts: tuple[int, ...], data: st.DataObject
) -> None:
    count = data.draw(st.sampled_from(counts))
    values = data.draw(st.lists(NUMBER, min_size=count, max_size=count))
    distortion = [*values, 0.0] if count == 4 else [*values[:12], 0.0, 0.0][:count]
    fx, fy = data.draw(FOCAL), data.draw(FOCAL)
    cx, cy = data.draw(NUMBER), data.draw(NUMBER)
    camera = replace(_camera(), fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
    lens = read(WRITERS[program](camera), tmp_path_factory.getbasetemp())
    assert lens.pinhole == (fx, fy, cx, cy)
    assert lens.size == (camera.width, camera.height)
    padded = [*lens.distortion, *[0.0] * 14][:14]
    assert padded == [*distortion, *[0.0] * 14][:14]


def _camera() -> Camera:
    return read_setup_file(EXAMPLES / "v_groove" / "recording.toml").setup.camera


@pytest.mark.parametrize(
    ("program", "distortion", "lost"),
    [
        ("kalibr", (-0.3, 0.1, 0.0, 0.0, 0.02), "k3 = 0.02 is not 0: Kalibr has k1 k2 p1 p2 alone"),
        ("ros", (*[0.1] * 8, 0.001, *[0.0] * 5), "s1 = 0.001 is not 0: ROS has"),
        ("mrcal", (*[0.1] * 13, 0.2), "tau_x = 0.1, tau_y = 0.2 is not 0: mrcal has"),
    ],
)
def test_what_a_program_cannot_hold_is_not_written(
    program: str, distortion: tuple[float, ...], lost: str, tmp_path: Path
) -> None:
    setup = copied_setup(tmp_path)
    old = next(line for line in setup.read_text().splitlines() if line.startswith("distortion"))
    setup.write_text(setup.read_text().replace(old, f"distortion = {list(distortion)}"))
    result = export_lens(setup, "--format", program, "--out", tmp_path / "out")
    assert isinstance(result.exception, ArctrackError)
    assert lost in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_the_commands_keep_the_setup_before_and_say_where_a_lens_is_from(tmp_path: Path) -> None:
    setup = copied_setup(tmp_path)
    setup.write_text(
        setup.read_text() + "# mine\n\n[calibration.laser]\nparameters = []\nsigma = []\ncovariance = []\n"
    )
    before = setup.read_text()
    file = tmp_path / "camera.yaml"
    file.write_text(ROS)
    result = import_lens(file, "--setup", setup)
    assert result.exit_code == 0, result.output
    assert "[calibration.laser]: found with the lens before; calibrate anew" in result.output
    assert (tmp_path / "recording.toml.1").read_text() == before
    assert "# mine" in setup.read_text()
    camera = tomllib.loads(setup.read_text())["camera"]
    assert (camera["fx"], camera["cy"], camera["distortion"]) == (
        500.5,
        240.75,
        [-0.36, 0.2, 1e-05, -4.5e-4, 0.0],
    )
    record = tomllib.loads(setup.read_text())["calibration"]["camera"]
    assert (record["made_by"], record["source"], record["program"]) == (
        "arctrack calibrate import",
        "camera.yaml",
        "ROS",
    )
    assert export_lens(setup, "--format", "mrcal", "--out", tmp_path / "x.cameramodel").exit_code == 0
    assert read_lens(tmp_path / "x.cameramodel", None).pinhole == (500.5, 501.5, 320.25, 240.75)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            MRCAL.replace("OPENCV5", "SPLINED_STEREOGRAPHIC_order=3"),
            "mrcal-convert-lensmodel LENSMODEL_OPENCV8",
        ),
        (MRCAL.replace("OPENCV5", "CAHVOR"), "lensmodel = LENSMODEL_CAHVOR: only PINHOLE"),
        (MRCAL.replace("OPENCV5", "OPENCV8"), "intrinsics: has 9 numbers, must have 12"),
        (MRCAL.replace("'imagersize'", "'size'"), "imagersize: missing"),
        (MRCAL.replace("1761.181055", "None"), "intrinsics[0] = None: must be a finite number"),
        (MRCAL.replace("1761.181055", "__import__('os').getpid()"), "must be a finite number"),
        (KALIBR[: KALIBR.index("cam1")].replace("radtan", "fov"), "distortion_model = 'fov': must be radtan"),
        (
            KALIBR[: KALIBR.index("cam1")].replace("[752, 480]", "[752]"),
            "resolution: has 1 numbers, must have 2",
        ),
        (ROS.replace("plumb_bob", "brown"), "distortion_model = 'brown': must be plumb_bob"),
        (ROS.replace("500.5", ".nan"), "camera_matrix[0] = nan: must be a finite number"),
        (ROS.replace("500.5", "true"), "camera_matrix[0] = True: must be a finite number"),
        (ROS.replace("500.5", "0").replace("501.5", "0"), "a camera without calibration has 0"),
        (ROS.replace("500.5, 0,", "500.5, 2,"), "camera_matrix: must be fx 0 cx, 0 fy cy, 0 0 1"),
        (ROS.replace("500.5", "50.5"), "fx and fy differ more than twofold"),
        (ROS.replace("image_height: 480\n", ""), "image_height: missing"),
        (ROS.replace("640", "640.5"), "image_width = 640.5: must be a whole number"),
        (ROS.replace("640", "1280"), "is of images of 1280 x 480 px, but [camera] width, height"),
        (ROS.replace("cols: 5", "cols: 5:"), "line 12: is no YAML"),
        (ROS.replace("500.5", "5e7").replace("501.5", "5e7"), "fx = 50000000.0: input should be less"),
        (CAMERA_INFO.replace("x_offset: 320", "x_offset: 900"), "reaches beyond the image of 1280 x 1024 px"),
        (HALCON.replace("0.00806039", "0"), "Focus = '0': must be above 0, in m; a telecentric lens"),
        (HALCON + "Tilt:tilt: 3.0;\n", "a tilted lens has other parameters in OpenCV"),
        (HALCON.replace("-2253.5", "-80000"), "the division distortion has no ray for parts of the image"),
        (HALCON.replace("Sx:sx: 1.0629e-05;", ""), "Sx: missing"),
        ("%YAML:1.0\n---\ncamera_matrix: [", "is no valid file of OpenCV's"),
        ("[" * 5000, "is no YAML"),
        ("a text", "holds no keys of a camera"),
        ("name: camera\nk1: 0.1\n", "holds no camera that arctrack knows"),
    ],
)
def test_what_a_setup_cannot_hold_is_a_line_of_error(text: str, problem: str, tmp_path: Path) -> None:
    setup = copied_setup(tmp_path)
    before = setup.read_text()
    file = tmp_path / "lens.txt"
    file.write_text(text)
    result = import_lens(file, "--setup", setup)
    assert isinstance(result.exception, ArctrackError)
    assert problem in str(result.exception)
    assert str(result.exception).startswith(str(file))
    assert setup.read_text() == before
    assert math.isfinite(read_setup_file(setup).setup.camera.fx)
