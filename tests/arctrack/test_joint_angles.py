"""Joint angles in a file of the robot's poses."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from arctrack.errors import ArctrackError
from arctrack.recording.importing.columns import CsvColumns
from arctrack.recording.importing.image_files import ImageSeries
from arctrack.recording.importing.pose_files import read_pose_table
from arctrack.recording.importing.units import Units, parse_units
from noise_model.compiled.arrays import Float64

PLACE, KUKA, NUMBERS = "x_mm,y_mm,z_mm", "a_deg,b_deg,c_deg", "600,20,300,10,5,170"


def joint_rad(
    folder: Path,
    header: str,
    row: str,
    rotation: str | None = "kuka",
    units: Units | None = None,
    named: Mapping[str, str] | None = None,
) -> Float64 | None:
    path = folder / "poses.csv"
    path.write_text(f"{header}\n{row}\n{row}\n")
    series = ImageSeries((Path("a.png"), Path("b.png")), (0, 1), 1, ())
    columns = CsvColumns(path, named or {}, "poses")
    return read_pose_table(
        columns, rotation, units or Units(), series, is_timed=False, with_joints=True
    ).joint_rad


@pytest.mark.parametrize("stem", ["j{}_deg", "q{} [deg]", "rax_{}", "A{}"])
def test_joint_angles_are_read_in_their_unit(stem: str, tmp_path: Path) -> None:
    names = ",".join(stem.format(n) for n in range(1, 7))
    read = joint_rad(tmp_path, f"{PLACE},{KUKA},{names}", f"{NUMBERS},10,-20,30,40,-50,60")
    assert read is not None
    np.testing.assert_allclose(np.degrees(read), [[10, -20, 30, 40, -50, 60]] * 2)


def test_a_name_is_given_by_column(tmp_path: Path) -> None:
    names = ",".join(f"achse{n}" for n in range(1, 7))
    named = {f"j{n}": f"achse{n}" for n in range(1, 7)}
    read = joint_rad(tmp_path, f"{PLACE},{KUKA},{names}", f"{NUMBERS},1,2,3,4,5,6", named=named)
    assert read is not None
    assert np.degrees(read[0, 5]) == pytest.approx(6.0)


@pytest.mark.parametrize("with_joints", [False, True])
def test_a_quaternion_is_none(with_joints: bool, tmp_path: Path) -> None:
    joints = ",".join(f"j{n}_rad" for n in range(1, 7))
    header, row = f"{PLACE},q1,q2,q3,q4", "600,20,300,1,0,0,0"
    if with_joints:
        header, row = f"{header},{joints}", f"{row},0.1,0.2,0.3,0.4,0.5,0.6"
    read = joint_rad(tmp_path, header, row, "abb")
    assert (read is None) != with_joints
    if read is not None:
        assert read[0, 0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("names", "units", "line"),
    [
        ("j1,j2,j3,j5,j6", "deg", r"no column is called j4; name it, as by --column j4=NAME"),
        ("j1,j2,j3,j4,j5,j6", None, r"the column j1 states no unit: give --units deg or rad"),
        ("j1_deg,j2_deg,j3_rad,j4_deg,j5_deg,j6_deg", None, r"j1_deg to j6_deg: joint angles need one unit"),
    ],
)
def test_a_mistake_is_named_with_its_cure(names: str, units: str | None, line: str, tmp_path: Path) -> None:
    row = "600,20,300,1,0,0,0," + ",".join("1" for _ in names.split(","))
    stated = None if units is None else parse_units(units)
    with pytest.raises(ArctrackError, match=line):
        joint_rad(tmp_path, f"{PLACE},qx,qy,qz,qw,{names}", row, None, stated)
