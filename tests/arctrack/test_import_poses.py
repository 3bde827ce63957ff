"""Poses as controllers write them: conventions against elementary rotations, units, columns, matrices."""

from __future__ import annotations

import unicodedata
from pathlib import Path
from typing import Literal

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from arctrack.errors import ArctrackError
from arctrack.recording.importing.columns import CsvColumns, image_parser
from arctrack.recording.importing.image_files import ImageSeries
from arctrack.recording.importing.matrix_files import read_matrices
from arctrack.recording.importing.pose_files import PoseFile, read_poses
from arctrack.recording.importing.rotations import convention
from arctrack.recording.importing.units import UNSTATED, parse_units, split_unit
from noise_model.compiled.arrays import Float64
from robot_io import BusLogWriter, PoseKind, Protector, RobotPosePosition, RobotPoseRotation

Form = Literal["NFC", "NFD"]

ANGLES = arrays(np.float64, 3, elements=st.floats(-180.0, 180.0))
AXES = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}


def turn(axis: str, angle_deg: float) -> Float64:
    """Return the rotation about one axis, entry by entry."""
    first, second = AXES[axis]
    R = np.eye(3)
    R[first, first] = R[second, second] = np.cos(np.radians(angle_deg))
    R[second, first] = np.sin(np.radians(angle_deg))
    R[first, second] = -R[second, first]
    return R


def read_as(name: str, numbers: Float64, *, degrees: bool) -> Float64:
    written = convention(name)
    assert written.are_angles == degrees
    values = np.radians(numbers) if degrees else np.asarray(numbers)
    return written.matrices(values[None])[0]


CONTROLLERS = {
    "kuka": lambda a, b, c: turn("z", a) @ turn("y", b) @ turn("x", c),
    "fanuc": lambda w, p, r: turn("z", r) @ turn("y", p) @ turn("x", w),
    "yaskawa": lambda rx, ry, rz: turn("z", rz) @ turn("y", ry) @ turn("x", rx),
    "staubli": lambda rx, ry, rz: turn("x", rx) @ turn("y", ry) @ turn("z", rz),
    "ZYX": lambda a, b, c: turn("z", a) @ turn("y", b) @ turn("x", c),
    "xyz": lambda a, b, c: turn("z", c) @ turn("y", b) @ turn("x", a),
    "ZYZ": lambda a, b, c: turn("z", a) @ turn("y", b) @ turn("z", c),
    "zxz": lambda a, b, c: turn("z", c) @ turn("x", b) @ turn("z", a),
}
"""What each convention's three angles compose to, written out from its source."""


@pytest.mark.parametrize("name", CONTROLLERS)
@given(angles_deg=ANGLES)
def test_angles_compose_as_their_controller_says(name: str, angles_deg: Float64) -> None:
    expected = CONTROLLERS[name](*angles_deg)
    np.testing.assert_allclose(read_as(name, angles_deg, degrees=True), expected, atol=1e-12)


@given(angles_deg=ANGLES)
def test_a_sequence_that_turns_along_is_the_fixed_one_backwards(angles_deg: Float64) -> None:
    along, fixed = read_as("XYZ", angles_deg, degrees=True), read_as("zyx", angles_deg[::-1], degrees=True)
    np.testing.assert_allclose(along, fixed, atol=1e-12)


@given(angles_deg=ANGLES)
def test_vectors_and_quaternions_give_the_rotation_back(angles_deg: Float64) -> None:
    """Axis and angle are taken from the matrix by its own definition: eigenvector and trace."""
    R = turn("z", angles_deg[0]) @ turn("y", angles_deg[1]) @ turn("x", angles_deg[2])
    angle = np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    if not 1e-2 < angle < np.pi - 1e-2:
        return
    axis = skew / np.linalg.norm(skew)
    for name in ("ur", "rotvec"):
        np.testing.assert_allclose(read_as(name, np.degrees(angle) * axis, degrees=True), R, atol=1e-9)
    x, y, z, w = *(np.sin(angle / 2.0) * axis), np.cos(angle / 2.0)
    for name, quaternion in {"xyzw": (x, y, z, w), "wxyz": (w, x, y, z), "abb": (w, x, y, z)}.items():
        for sign in (1.0, -1.0):
            R_read = read_as(name, sign * np.array(quaternion), degrees=False)
            np.testing.assert_allclose(R_read, R, atol=1e-9)


@pytest.mark.parametrize("name", ["XXY", "xyy", "xYz", "euler", "KUKA", ""])
def test_a_convention_that_is_none(name: str) -> None:
    with pytest.raises(ArctrackError, match=rf"--rotation {name}: there are xyzw, .*kuka"):
        convention(name)


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("x_mm", "x", "mm"),
        ("X [mm]", "x", "mm"),
        ("x(m)", "x", "m"),
        ("Timestamp_ns", "timestamp", "ns"),
        ("t µs", "t", "us"),
        ("A [°]", "a", "deg"),
        ("laser_on", "laser_on", None),
        ("frames", "frames", None),
        ("current_a", "current_a", None),
    ],
)
def test_a_header_states_its_unit(header: str, name: str, unit: str | None) -> None:
    assert split_unit(header) == (name, unit)


def series(count: int) -> ImageSeries:
    return ImageSeries(tuple(Path(f"img_{n}.png") for n in range(count)), tuple(range(count)), 1, ())


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.csv"
    path.write_text(text, encoding="utf-8")
    return path


def poses_of(
    path: Path, rotation: str | None = None, units: str = "", images: int = 2, **named: str
) -> PoseFile:
    return read_poses(path, None, rotation, parse_units(units), named, series(images), False)[0]


def test_columns_are_taken_by_name_in_any_order(tmp_path: Path) -> None:
    text = "speed,C,B,A,Z,Y,X,T [ms]\n9,10,20,30,3,2,1,500\n9,11,21,31,6,5,4,1500\n"
    poses = poses_of(written(tmp_path, text), "kuka")
    assert poses.times_s is not None
    np.testing.assert_allclose(poses.times_s, [0.5, 1.5])
    np.testing.assert_allclose(poses.T_base_tool[1, :3, 3], [4.0, 5.0, 6.0])
    np.testing.assert_allclose(
        poses.T_base_tool[0, :3, :3], CONTROLLERS["kuka"](30.0, 20.0, 10.0), atol=1e-12
    )
    assert poses.rows is None
    assert poses.units == "mm, deg"


def test_columns_are_taken_as_the_user_names_them(tmp_path: Path) -> None:
    text = "p0,p1,p2,r0,r1,r2\n" + "0.1,0.2,0.3,0,0,1.5\n" * 2
    poses = poses_of(written(tmp_path, text), "ur", x="p0", y="p1", z="p2", rx="r0", ry="r1", rz="r2")
    np.testing.assert_allclose(poses.T_base_tool[0, :3, 3], [100.0, 200.0, 300.0])
    np.testing.assert_allclose(poses.T_base_tool[0, :3, :3], turn("z", np.degrees(1.5)), atol=1e-12)


def test_a_controllers_own_columns_are_no_times_and_no_images(tmp_path: Path) -> None:
    """KUKA's turn bits are called T; a log with times may have a column of user frames."""
    poses = poses_of(written(tmp_path, f"{HEAD},S,T\n" + f"{ROW},2,35\n" * 2), "kuka")
    assert poses.times_s is None
    path = written(tmp_path, f"time,frame,{HEAD}\n1,7,{ROW}\n2,7,{ROW}\n")
    logged, _ = read_poses(path, None, "kuka", parse_units("s"), {}, series(2), True)
    assert logged.times_s is not None
    assert logged.rows is None
    assert poses_of(written(tmp_path, f"t,{HEAD}\n5,{ROW}\n"), "kuka", "ms", time="t").times_s == [0.005]


def test_poses_without_times_belong_to_images_by_their_key(tmp_path: Path) -> None:
    rows = ("c:\\scan\\img_1.png,1,0,0", "img_7.png,7,7,7", "img_0.png,0,0,0")
    text = "file,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(f"{row},1,0,0,0\n" for row in rows)
    poses = poses_of(written(tmp_path, text))
    assert poses.rows is not None
    assert poses.T_base_tool[poses.rows, 0, 3].tolist() == [0.0, 1000.0]
    assert poses.notes == ("1 rows of robot.csv are of no image",)


@pytest.mark.parametrize(("stored", "listed"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_an_umlaut_names_the_same_image_however_it_is_written(stored: Form, listed: Form) -> None:
    paths = [Path(unicodedata.normalize(stored, f"Naht_für_{n}.png")) for n in range(2)]
    position_of = image_parser(ImageSeries(tuple(paths), (0, 1), 1, ()))
    assert position_of(unicodedata.normalize(listed, "D:\\Naht\\Naht_für_1.png")) == 1.0


def test_numbered_quaternions_have_the_order_that_is_stated(tmp_path: Path) -> None:
    turned = f"{np.cos(0.2)},0,0,{np.sin(0.2)}"
    for header in ("q1,q2,q3,q4", "q0,q1,q2,q3"):
        text = f"x,y,z,{header}\n" + f"1,2,900,{turned}\n" * 2
        poses = poses_of(written(tmp_path, text), "abb")
        np.testing.assert_allclose(poses.T_base_tool[0, :3, :3], turn("z", np.degrees(0.4)), atol=1e-12)
        with pytest.raises(ArctrackError, match=r"no columns are called qx, qy, qz, qw: say by --rotation"):
            poses_of(written(tmp_path, text), units="mm")


HEAD, ROW = "x,y,z,a,b,c", "100,200,900,10,20,30"
REFUSED = {
    "no unit of length": (
        "x,y,z,qx,qy,qz,qw\n0,0,9,0,0,0,1\n",
        None,
        "",
        "the column x states no unit: give --units mm or m",
    ),
    "no unit of angle": (
        f"{HEAD}\n".replace("a,b,c", "rz,ry,rx") + ROW,
        "ZYX",
        "mm",
        "the column rz states no unit: give --units deg or rad",
    ),
    "no unit of time": (
        f"time,{HEAD}\n1,{ROW}\n",
        "kuka",
        "",
        "the column time states no unit: give --units s or ms or us or ns",
    ),
    "two units": (
        f"{HEAD}\n{ROW}".replace("x,", "x_mm,"),
        "kuka",
        "m",
        "the column x_mm: its name says mm, --units says m",
    ),
    "mixed units": (
        f"{HEAD}\n{ROW}".replace("x,", "x_m,"),
        "kuka",
        "",
        "m, mm, mm, deg, deg, deg: coordinates need one unit",
    ),
    "metres that are mm": (
        f"{HEAD}\n{ROW}",
        "kuka",
        "m",
        "coordinates reach 900 m: they are mm; give --units mm",
    ),
    "radians that are degrees": (
        f"{HEAD}\n{ROW}",
        "kuka",
        "rad",
        "angles reach 30 rad: they are degrees; give --units deg",
    ),
    "a column": (
        "X1,Y1,Z1,a,b,c\n1,2,3,4,5,6\n",
        "kuka",
        "",
        "no column is called x; name it, as by --column x=X1; there are X1, Y1, Z1",
    ),
    "a rotation's column": (
        "x,y,z,a,b\n1,2,3,4,5\n",
        "kuka",
        "",
        "no column is called c; name it, as by --column c=",
    ),
    "two columns": (
        "x,x_mm,y,z,a,b,c\n1,1,2,3,4,5,6\n",
        "kuka",
        "",
        "x and x_mm may both be x; say which, as by --column x=x",
    ),
    "both decimal signs": (
        "x;y;z;a;b;c\n1,5;2;3;0;0;0\n1;2.5;3;0;0;0\n",
        "kuka",
        "",
        "line 3: y = '2.5': the file writes 2.5 and 1,5: write all numbers with points",
    ),
    "dates and numbers": (
        f"time,{HEAD}\n2024-05-01T10:00:00,{ROW}\n1714557601,{ROW}\n",
        "kuka",
        "",
        "line 3: time = '1714557601': is another kind of time than those before",
    ),
    "a date that is none": (
        f"time,{HEAD}\n01.05.2024 10:00,{ROW}\n",
        "kuka",
        "",
        "must be a finite number, or a date such as 2024-05-01T10:00:00.125+02:00",
    ),
    "no header": (
        "1,2,3,4,5,6\n",
        "kuka",
        "",
        "holds numbers where the header should be: begin the file with x,y,z,a,b,c,",
    ),
    "no rotation": (
        "x,y,z,qx,qy,qz,qw\n0,0,9,0,0,0,1\n0,0,9,0,1,0,1\n",
        None,
        "mm",
        "line 3: the quaternion's norm is 1.4142, not 1",
    ),
    "times": (
        f"t_s,{HEAD}\n1,{ROW}\n1,9{ROW}\n",
        "kuka",
        "",
        "line 3: t_s = 1.000000 does not come after 1.000000 of line 2: one time has two poses",
    ),
    "times that fall": (
        f"t_s,{HEAD}\n1,{ROW}\n0.5,{ROW}\n",
        "kuka",
        "",
        "line 3: t_s = 0.500000 does not come after 1.000000 of line 2: times must rise",
    ),
    "nanoseconds": (f"t_s,{HEAD}\n1e12,{ROW}\n", "kuka", "", "1e+12 s is beyond 1e+11 s; give --units ms"),
    "another count": (
        f"{HEAD}\n{ROW}\n",
        "kuka",
        "",
        "has 1 rows for 2 images: add a column time, file or frame",
    ),
    "a column twice": (f"{HEAD},x\n{ROW},1\n", "kuka", "", "the column x occurs twice: rename one"),
    "a row of units": (
        f"{HEAD}\nmm,mm,mm,deg,deg,deg\n{ROW}\n",
        "kuka",
        "",
        "line 2: holds no number: if it is a row of units, put # before it",
    ),
    "a title above the head": (
        f"Robot 4711, cell 2\n{HEAD}\n{ROW}\n",
        "kuka",
        "",
        "no head, put # before it",
    ),
    "cut off": (
        f"{HEAD}\n{ROW}\n{ROW[:6]}",
        "kuka",
        "",
        "line 3: has 2 values where the header names 6; the file is cut off: leave its last line out",
    ),
    "an image without a pose": (
        f"frame,{HEAD}\n0,{ROW}\n5,{ROW}\n",
        "kuka",
        "",
        "has no row for img_1.png (frame 1)",
    ),
    "two poses of an image": (
        f"frame,{HEAD}\n0,{ROW}\n1,{ROW}\n0,{ROW}\n",
        "kuka",
        "",
        "line 4: has a second row for img_0.png",
    ),
}


@pytest.mark.parametrize(("text", "rotation", "units", "line"), REFUSED.values(), ids=REFUSED)
def test_what_is_wrong_is_said(
    text: str, rotation: str | None, units: str, line: str, tmp_path: Path
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ArctrackError) as refused:
        poses_of(path, rotation, units)
    assert str(refused.value).startswith(f"{path}")
    assert line in str(refused.value)


def test_units_that_look_wrong_are_a_warning(tmp_path: Path) -> None:
    path = written(tmp_path, f"{HEAD}\n" + "0.4,-1.25,0.9,0.1,0.2,3.1\n" * 2)
    assert poses_of(path, "kuka").warnings == (
        f"{path}: coordinates stay within 1.25 mm of base's origin; are they m?",
        f"{path}: angles stay within 3.1 deg; are they rad?",
    )
    assert poses_of(path, "kuka", "m, rad").warnings == ()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("m, furlong", "--units m, furlong: furlong is not known; there are mm, m, deg, rad, s, ms, us, ns"),
        ("m mm", "--units m mm: states m and mm; leave one"),
    ],
)
def test_a_list_of_units_that_is_none(text: str, line: str) -> None:
    with pytest.raises(ArctrackError, match=line):
        parse_units(text)


def opencv(rows: int, cols: int, dt: str, values: Float64) -> str:
    """Return OpenCV's YAML of a matrix, laid out as OpenCV writes it."""
    lines = [f"K1: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: {dt!r}".replace("'", '"')]
    return (
        "%YAML:1.0\n---\n"
        + lines[0]
        + "\n   data: [ "
        + ", ".join(map(repr, values.ravel().tolist()))
        + " ]\n"
    )


R_TWO = np.stack([turn("x", 190.0) @ turn("z", 20.0), turn("y", 170.0)])
T_TWO = np.array([[701.29, 124.003, 343.087], [736.18, 119.856, 291.653]])


def rows_of(blocks: Float64) -> str:
    return "\n".join(" ".join(map(repr, row)) for row in blocks.reshape(-1, blocks.shape[-1]).tolist())


@pytest.mark.parametrize(
    ("rotations", "translations"),
    [
        (opencv(2, 3, "3d", R_TWO), opencv(2, 3, "d", T_TWO)),
        (f"# rotations\n{rows_of(R_TWO)}\n", rows_of(T_TWO)),
        (rows_of(R_TWO.reshape(2, 9)), rows_of(T_TWO.reshape(6, 1))),
    ],
    ids=["opencv", "blocks", "rows"],
)
def test_matrices_are_read_row_by_row(rotations: str, translations: str, tmp_path: Path) -> None:
    (tmp_path / "R.txt").write_text(rotations)
    (tmp_path / "t.txt").write_text(translations)
    T_base_tool, _ = read_matrices(tmp_path / "R.txt", tmp_path / "t.txt", 1000.0)
    np.testing.assert_allclose(T_base_tool[:, :3, :3], R_TWO, atol=1e-12)
    np.testing.assert_allclose(T_base_tool[:, :3, 3], 1000.0 * T_TWO, rtol=1e-15)


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("is_flat", [False, True])
def test_whole_poses_are_read(rows: int, is_flat: bool, tmp_path: Path) -> None:
    # Four poses: 3 x 4 blocks of so many could be taken for 4 x 4.
    expected = np.tile(np.eye(4), (4, 1, 1))
    expected[:, :3, :3], expected[:, :3, 3] = np.tile(R_TWO, (2, 1, 1)), np.tile(T_TWO, (2, 1))
    blocks = expected[:, :rows]
    (tmp_path / "T.txt").write_text(rows_of(blocks.reshape(4, -1) if is_flat else blocks))
    np.testing.assert_allclose(read_matrices(tmp_path / "T.txt", None, 1.0)[0], expected, atol=1e-12)


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("is_flat", [False, True])
def test_whole_poses_that_stand_column_by_column_are_read(rows: int, is_flat: bool, tmp_path: Path) -> None:
    expected = np.tile(np.eye(4), (4, 1, 1))
    expected[:, :3, :3], expected[:, :3, 3] = np.tile(R_TWO, (2, 1, 1)), np.tile(T_TWO, (2, 1))
    blocks = expected[:, :rows].swapaxes(1, 2)
    (tmp_path / "T.txt").write_text(rows_of(blocks.reshape(4, -1) if is_flat else blocks))
    T_base_tool, notes = read_matrices(tmp_path / "T.txt", None, 1.0)
    np.testing.assert_allclose(T_base_tool, expected, atol=1e-12)
    assert notes == ("the matrices stand column by column, and are read so",)


@pytest.mark.parametrize(
    ("rotations", "translations", "line"),
    [
        (rows_of(R_TWO), "1 2 3", "t.txt: holds 3 numbers for 2 rotations: three for each are needed"),
        (
            rows_of(2.0 * R_TWO),
            rows_of(T_TWO),
            "R.txt: matrix 1 is no rotation: R Rᵀ is off the identity by 3",
        ),
        (rows_of(-R_TWO), rows_of(T_TWO), "R.txt: matrix 1 is no rotation: it mirrors"),
        ("1 2 3\n1 2\n", "1", "R.txt, line 2: has 2 numbers where the first row has 3"),
        ("1 2 3\n1 two 3\n", "1", "R.txt, line 2: holds text where numbers are needed"),
        ("1 2\n1 2\n", "1", "R.txt: holds rows of 2 numbers: matrices of 3 x 3 are needed"),
        ("%YAML:1.0\n---\nK1: [ 1, 2", "1", "R.txt: is no valid file of OpenCV's"),
        ("%YAML:1.0\n---\nK1: 3\n", "1", "R.txt: holds no matrix"),
        ("# nothing\n", "1", "R.txt: holds no numbers"),
        ("nan 0 0\n0 1 0\n0 0 1\n", "1 2 3", "R.txt: holds a number that is not finite"),
        (rows_of(R_TWO), None, "R.txt: holds rows of 3 numbers: poses of 4 x 4 are needed"),
    ],
)
def test_matrices_that_are_none(rotations: str, translations: str | None, line: str, tmp_path: Path) -> None:
    (tmp_path / "R.txt").write_text(rotations)
    if translations is not None:
        (tmp_path / "t.txt").write_text(translations)
    with pytest.raises(ArctrackError) as refused:
        read_matrices(tmp_path / "R.txt", None if translations is None else tmp_path / "t.txt", 1.0)
    assert str(refused.value).startswith(f"{tmp_path}/{line}")


def test_the_names_of_columns_are_those_of_the_header(tmp_path: Path) -> None:
    path = written(tmp_path, "time,x\n1,2\n")
    assert CsvColumns(path, {}, "x").find(("time", "t")) is not None
    assert parse_units("") == UNSTATED


POSES = ((0.0, 0.1, -0.2, 0.3, 0.05, -0.02, 0.001), (0.01, 0.1015, -0.2, 0.3, 0.05, -0.02, 0.001))
RTDE = "timestamp " + " ".join(f"actual_TCP_pose_{n}" for n in range(6))


def rows_as(separator: str, comma: bool = False, end: str = "") -> str:
    texts = [separator.join(map(repr, row)) + end for row in POSES]
    return "\n".join(text.replace(".", ",") if comma else text for text in texts) + "\n"


TABLES = {
    "blanks": f"{RTDE}\n{rows_as(' ')}",
    "columns in line": f"{RTDE}\n{rows_as('    ')}",
    "tabs": f"{RTDE.replace(' ', chr(9))}\n{rows_as(chr(9))}",
    "semicolons and decimal commas": f"{RTDE.replace(' ', ';')}\n{rows_as(';', comma=True)}",
    "a separator at each row's end": f"{RTDE.replace(' ', ';')}\n{rows_as(';', end=';')}",
    "Excel's first line": f"sep=;\n{RTDE.replace(' ', ';')}\n{rows_as(';')}",
    "blanks and decimal commas": f"{RTDE}\n{rows_as(' ', comma=True)}",
    "commas and quoted decimal commas": f"{RTDE.replace(' ', ',')}\n"
    + "\n".join(",".join(f'"{value}"'.replace(".", ",") for value in row) for row in POSES),
    "remarks before the head": f"# UR10e, cell 4\n#\n% 2024, May\n{RTDE.replace(' ', ',')}\n{rows_as(',')}",
    "the head as a remark": f"# a trajectory\n# {RTDE}\n{rows_as(' ')}# end\n",
    "units below the head, as a remark": f"{RTDE}\n# s m m m rad rad rad\n{rows_as(' ')}",
    "both as remarks": f"# {RTDE}\n# s m m m rad rad rad\n{rows_as(' ')}",
    "the head as a remark, with commas": f"#{RTDE.replace(' ', ',')}\n{rows_as(', ')}",
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read_whatever_parts_its_columns(name: str, tmp_path: Path) -> None:
    poses = poses_of(written(tmp_path, TABLES[name]), "ur", "s")
    assert poses.times_s is not None
    np.testing.assert_array_equal(poses.times_s, [0.0, 0.01])
    np.testing.assert_allclose(poses.T_base_tool[:, :3, 3], [[100.0, -200.0, 300.0], [101.5, -200.0, 300.0]])
    np.testing.assert_array_equal(poses.rotation, [row[4:] for row in POSES])
    assert poses.units == "m, rad"


def test_a_trajectory_of_tum_has_its_head_as_a_remark(tmp_path: Path) -> None:
    text = (
        "# ground truth\n# timestamp tx ty tz qx qy qz qw\n1.0 0.4 0.1 0.2 0 0 0 1\n2.0 0.5 0.1 0.2 0 0 0 1\n"
    )
    poses = poses_of(written(tmp_path, text), None, "m, s")
    np.testing.assert_allclose(poses.T_base_tool[:, :3, 3], [[400.0, 100.0, 200.0], [500.0, 100.0, 200.0]])


@pytest.mark.parametrize(
    ("dates", "notes"),
    [
        (("2024-05-01T12:00:00.5+02:00", "2024-05-01T10:00:01Z"), ()),
        (("2024-05-01 10:00:00.5", "2024-05-01 10:00:01"), ("dates without a time zone are taken as UTC",)),
    ],
)
def test_times_may_be_dates(dates: tuple[str, str], notes: tuple[str, ...], tmp_path: Path) -> None:
    text = f"time,{HEAD}\n" + "".join(f"{date},{ROW}\n" for date in dates)
    poses = poses_of(written(tmp_path, text), "kuka")
    assert poses.times_s is not None
    np.testing.assert_allclose(poses.times_s, [1_714_557_600.5, 1_714_557_601.0], rtol=0.0, atol=1e-6)
    assert poses.notes == notes


def test_rows_that_repeat_the_row_before_are_left_out(tmp_path: Path) -> None:
    """As a Motoman writes them: some poses are logged twice, with one time."""
    text = f"t_s,{HEAD}\n0,{ROW}\n0,{ROW}\n1,{ROW}\n2,{ROW}\n2.0,{ROW}\n2,{ROW}\n"
    poses = poses_of(written(tmp_path, text), "kuka")
    assert poses.times_s is not None
    assert poses.times_s.tolist() == [0.0, 1.0, 2.0]
    assert len(poses.T_base_tool) == 3
    assert poses.notes == ("3 rows repeat the row before and are left out",)


@pytest.mark.parametrize("name", ["bus.log", "bus.asc", "bus.blf"])
def test_poses_may_be_those_of_a_can_log(name: str, tmp_path: Path) -> None:
    path, protector = tmp_path / name, Protector()
    with BusLogWriter(path) as log:
        for n in range(3):
            for message in (
                RobotPosePosition(100.0 + n, -5.0, 40.0, PoseKind.ACTUAL),
                RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 0.0),
            ):
                identifier, payload = protector.protect(message)
                log.write(can.Message(1.0 + 0.01 * n, identifier, is_extended_id=False, data=payload))
    poses = poses_of(path, None)
    assert poses.times_s is not None
    np.testing.assert_allclose(poses.times_s, [1.0, 1.01, 1.02], atol=1e-6)
    np.testing.assert_allclose(poses.T_base_tool[:, 0, 3], [100.0, 101.0, 102.0])
    assert poses.warnings == ()
