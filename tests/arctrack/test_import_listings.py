"""Poses in the files that controllers keep their points in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_import_poses import poses_of, turn, written

from arctrack.errors import ArctrackError

RAPID = """MODULE Module1
  PERS tooldata torch:=[TRUE,[[8.8,-172.6,105.1],[0.43,0.84,0.15,0.3]],[4,[0,0,0],[1,0,0,0],0,0,0]];
  PERS wobjdata table:=[FALSE,TRUE,"",[[1,2,3],[1,0,0,0]],[[4,5,6],[1,0,0,0]]];
  CONST robtarget p10:=[[600,500,225.3],[0,0,1,0],[0,-1,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];
  ! CONST robtarget p15:=[[0,0,0],[1,0,0,0],[0,-1,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];
  CONST robtarget p20:=[[ 601.5, -500, 2.253E+2 ],[0.707107,0.707107,0,0],[0,-1,0,0],[9E9,9E9]];
ENDMODULE
"""
KRL = """&ACCESS RVP
DEFDAT  SCAN
;FOLD EXTERNAL DECLARATIONS;%{PE}
;DECL E6POS XP0={X 0.0,Y 0.0,Z 0.0,A 0.0,B 0.0,C 0.0,S 2,T 35}
DECL E6POS XP1={X 600.0,Y 500.0,Z 225.3,A 180.0,B 0.0,C 180.0,S 2,T 35,E1 0.0,E2 0.0}
DECL FDAT FP1={TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}
DECL E6POS XP2={X 601.5, Y -500, Z 2.253E+02, A 0, B 0, C 90.0, S 2, T 35}
ENDDAT
"""
LS = """/PROG  SCAN
/MN
   1:L P[1] 100mm/sec FINE    ;
/POS
P[1]{
   GP1:
\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX =   600.000  mm,\tY =   500.000  mm,\tZ =   225.300  mm,
\tW =   180.000 deg,\tP =     -.000 deg,\tR =   180.000 deg
};
P[2:"end"]{
   GP1:
\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX =\t601.500\tmm,\tY =\t-500.000\tmm,\tZ =\t225.300\tmm,
\tW =\t90.000\tdeg,\tP =\t0.000\tdeg,\tR =\t.000\tdeg
};
/END
"""
SCRIPT = (
    f"def scan():\n  movel(p[0.6, 0.5, .2253, 0, {np.pi!r}, 0], a=1.2)\n"
    f"  movel(p[0.6015,-0.5,0.2253,{np.pi / 2!r},0,0])\nend\n"
)
LISTINGS = {"abb": RAPID, "kuka": KRL, "fanuc": LS, "ur": SCRIPT}


@pytest.mark.parametrize("name", LISTINGS)
def test_the_points_that_a_controller_keeps_are_read_in_their_order(name: str, tmp_path: Path) -> None:
    poses = poses_of(written(tmp_path, LISTINGS[name].replace("\n", "\r\n")), name)
    assert poses.times_s is None
    assert poses.rows is not None
    np.testing.assert_allclose(poses.T_base_tool[:, :3, 3], [[600.0, 500.0, 225.3], [601.5, -500.0, 225.3]])
    np.testing.assert_allclose(poses.T_base_tool[:, :3, :3], [turn("y", 180.0), turn("x", 90.0)], atol=1e-6)


@pytest.mark.parametrize(
    ("rotation", "more"),
    [
        ("kuka", "$BASE={X 1,Y 2,Z 3,A 0,B 0,C 0}\nTOOL_DATA[1]={X 1,Y 2,Z 3,A 0,B 0,C 0}\n"),
        ("kuka", "LIN_REL {X 1,Y 0,Z 0,A 0,B 0,C 0}\n"),
        ("ur", "# movel(p[1,2,3,0,0,0])\nset_tcp(p[0,0,0.1,0,0,0])\n"),
    ],
)
def test_frames_of_tools_and_bases_are_no_points(rotation: str, more: str, tmp_path: Path) -> None:
    poses = poses_of(written(tmp_path, more + LISTINGS[rotation]), rotation)
    np.testing.assert_allclose(poses.T_base_tool[:, 0, 3], [600.0, 601.5])


def test_a_program_without_points_is_no_table(tmp_path: Path) -> None:
    path = tmp_path / "pos.va"
    path.write_text("[*POSREG*]\n  X: 600.0   Y: 500.0\n")
    with pytest.raises(ArctrackError, match="holds no pose as fanuc lists them: give the file"):
        poses_of(path, "fanuc")


ROBTARGET = "[[{x},500,225.3],[0,0,1,0],[0,-1,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]]"


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("time;robtarget\n", "{t};{pose}\n"),
        ("", "{t} {pose}\n"),
        ("time,pose\n", '{t},"{pose}"\n'),
        ("", "2024-05-01T10:00:0{t}Z;{pose};\n"),
    ],
)
def test_a_log_of_robtargets_has_times(head: str, row: str, tmp_path: Path) -> None:
    rows = [(0.0, 600.0), (1.5, 601.0), (1.5, 601.0), (2.5, 602.0)]
    text = head + "".join(row.format(t=t, pose=ROBTARGET.format(x=x)) for t, x in rows)
    poses = poses_of(written(tmp_path, text), "abb", "s")
    assert poses.times_s is not None
    np.testing.assert_allclose(poses.times_s - poses.times_s[0], [0.0, 1.5, 2.5], atol=1e-6)
    np.testing.assert_allclose(poses.T_base_tool[:, 0, 3], [600.0, 601.0, 602.0])
    assert "1 rows repeat the row before and are left out" in poses.notes


def test_a_listing_may_name_the_images(tmp_path: Path) -> None:
    poses = [ROBTARGET.format(x=x) for x in (600.0, 601.0)]
    path = written(tmp_path, f"file;robtarget\nimg_1.png;{poses[1]}\nimg_0.png;{poses[0]}\n")
    listed = poses_of(path, "abb")
    assert listed.rows is not None
    np.testing.assert_allclose(listed.T_base_tool[listed.rows, 0, 3], [600.0, 601.0])


@pytest.mark.parametrize(
    ("rotation", "text", "line"),
    [
        (
            "fanuc",
            LS.replace("P[2", "P[2]{\n   GP1:\n\tJ1=     0.000 deg\n};\nP[3"),
            "line 11: a point without a pose",
        ),
        (
            "kuka",
            KRL.replace("DECL FDAT", "DECL E6POS XP9={X 1,Y 2}\nDECL FDAT"),
            "line 6: a point without a pose",
        ),
        ("abb", RAPID.replace("[0,0,1,0]", "[0,0,9,0]"), "line 4: the quaternion's norm is 9.0000, not 1"),
        ("ur", SCRIPT.replace("-0.5,", "y,"), "line 3: a point without a pose"),
        ("ur", SCRIPT.replace("p[0.6015", "pose_trans(a, p[0.6015"), "line 3: a point without a pose"),
        ("ur", SCRIPT + SCRIPT, "lists 4 poses for 2 images: one each is needed"),
        (
            "abb",
            f"1;{ROBTARGET.format(x=1)}\n",
            "the times before its poses state no unit: give --units s or ms",
        ),
    ],
)
def test_a_listing_that_cannot_be_taken_names_the_line(
    rotation: str, text: str, line: str, tmp_path: Path
) -> None:
    with pytest.raises(ArctrackError) as refused:
        poses_of(written(tmp_path, text), rotation)
    assert line in str(refused.value)
