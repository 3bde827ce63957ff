"""Common mistakes in a recording: each spoils a copy of one in place."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomlkit
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64, Integers
from noise_model.transforms import invert, pose_matrix

Table = list[dict[str, str]]


def edit_table(path: Path, edit: Callable[[dict[str, str]], None]) -> None:
    """Change each row of a CSV."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        edit(row)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def scale(column: str, factor: float) -> Callable[[dict[str, str]], None]:
    def edit(row: dict[str, str]) -> None:
        row[column] = repr(float(row[column]) * factor)

    return edit


def edit_poses(path: Path, edit: Callable[[Float64], Float64]) -> None:
    """Put another pose (4, 4) in each row's place."""

    def of_row(row: dict[str, str]) -> None:
        T_base_tool = edit(
            pose_matrix([float(row[f"{axis}_mm"]) for axis in "xyz"], [float(row[f"q{i}"]) for i in "xyzw"])
        )
        for axis, value in zip("xyz", T_base_tool[:3, 3], strict=True):
            row[f"{axis}_mm"] = f"{value:.6f}"
        quaternion = Rotation.from_matrix(T_base_tool[:3, :3]).as_quat(canonical=True)
        for i, value in zip("xyzw", quaternion, strict=True):
            row[f"q{i}"] = f"{value:.9f}"

    edit_table(path / "poses.csv", of_row)


def edit_setup(path: Path, edit: Callable[[Any], None]) -> None:
    """Change recording.toml."""
    document = tomlkit.parse((path / "recording.toml").read_text())
    edit(document)
    (path / "recording.toml").write_text(tomlkit.dumps(document))


def edit_frames(path: Path, edit: Callable[[Integers], Integers]) -> None:
    for file in sorted((path / "frames").iterdir()):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), np.ascontiguousarray(edit(image)))


def _turned(axis: str) -> Callable[[Path], None]:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, 180.0, degrees=True).as_matrix()
    return lambda path: edit_poses(path, lambda T_base_tool: T_base_tool @ turn)


def _wxyz(path: Path) -> None:
    def edit(row: dict[str, str]) -> None:
        row["qx"], row["qy"], row["qz"], row["qw"] = row["qw"], row["qx"], row["qy"], row["qz"]

    edit_table(path / "poses.csv", edit)


def _in_metres(path: Path) -> None:
    def edit(row: dict[str, str]) -> None:
        for axis in "xyz":
            row[f"{axis}_mm"] = f"{0.001 * float(row[f'{axis}_mm']):.9f}"

    edit_table(path / "poses.csv", edit)


def _hand_eye_inverted(path: Path) -> None:
    def edit(document: Any) -> None:
        pose = document["camera"]["pose_in_tool"]
        inverse = invert(pose_matrix(pose["translation_mm"], pose["quaternion_xyzw"]))
        pose["translation_mm"] = inverse[:3, 3].tolist()
        pose["quaternion_xyzw"] = Rotation.from_matrix(inverse[:3, :3]).as_quat().tolist()

    edit_setup(path, edit)


def _hand_eye_wxyz(path: Path) -> None:
    def edit(document: Any) -> None:
        pose = document["camera"]["pose_in_tool"]
        x, y, z, w = pose["quaternion_xyzw"]
        pose["quaternion_xyzw"] = [w, x, y, z]

    edit_setup(path, edit)


def _hand_eye_in_metres(path: Path) -> None:
    def edit(document: Any) -> None:
        pose = document["camera"]["pose_in_tool"]
        pose["translation_mm"] = [0.001 * value for value in pose["translation_mm"]]

    edit_setup(path, edit)


def _plane_sign(path: Path) -> None:
    def edit(document: Any) -> None:
        document["laser"]["plane_in_tool"][3] *= -1.0

    edit_setup(path, edit)


def _focal(factor: float) -> Callable[[Path], None]:
    def edit(document: Any) -> None:
        for name in ("fx", "fy"):
            document["camera"][name] = factor * document["camera"][name]

    return lambda path: edit_setup(path, edit)


def _joint(**table: Any) -> Callable[[Path], None]:
    def edit(document: Any) -> None:
        joint = document["joint"]
        for name in ("included_angle_deg", "depth_mm", "root_gap_mm"):
            joint.pop(name, None)
        for name, value in table.items():
            joint[name] = value

    return lambda path: edit_setup(path, edit)


def _normal_turned(path: Path) -> None:
    def edit(document: Any) -> None:
        document["joint"]["surface_normal_in_base"] = [0.0, 0.0, -1.0]

    edit_setup(path, edit)


def _key(table: str, name: str, change: Callable[[float], float]) -> Callable[[Path], None]:
    def changed(value: Any) -> Any:
        return [changed(item) for item in value] if isinstance(value, list) else change(value)

    def edit(document: Any) -> None:
        document[table][name] = changed(document[table][name])

    return lambda path: edit_setup(path, edit)


def sheet_moved(path: Path) -> None:
    """Move the laser's sheet by 3 mm."""

    def edit(document: Any) -> None:
        document["laser"]["plane_in_tool"][3] += 3.0

    edit_setup(path, edit)


def _metres(value: float) -> float:
    return 0.001 * value


def _of_larger_image(path: Path) -> None:
    for name in ("width", "height"):
        _key("camera", name, lambda value: 2 * value)(path)
    for name in ("fx", "fy", "cx", "cy"):
        _key("camera", name, lambda value: 2.0 * value)(path)


def _poses_in_cm(path: Path) -> None:
    for axis in "xyz":
        edit_table(path / "poses.csv", scale(f"{axis}_mm", 0.1))


def _poses_and_seam_in_metres(path: Path) -> None:
    _in_metres(path)
    _key("joint", "seam_in_base_mm", _metres)(path)


MISTAKES: dict[str, tuple[Callable[[Path], None], str]] = {
    "tool z down": (_turned("x"), "the poses' tool z points into the part (its +x is arctrack's x)"),
    "tool z down, x back": (_turned("y"), "the poses' tool z points into the part (its -x is arctrack's x)"),
    "tool x back": (_turned("z"), "the poses' tool x does not point along the travel"),
    "pose quaternions w x y z": (_wxyz, "the poses have their quaternions as w x y z"),
    "poses inverted": (lambda path: edit_poses(path, invert), "the poses are inverted"),
    "pose times in ms": (
        lambda path: edit_table(path / "poses.csv", scale("timestamp_s", 1e3)),
        "the times of poses are in ms",
    ),
    "frame times in ms": (
        lambda path: edit_table(path / "frames.csv", scale("timestamp_s", 1e3)),
        "the times of frames are in ms",
    ),
    "poses in m": (_in_metres, "the poses are in m"),
    "hand-eye inverted": (_hand_eye_inverted, "[camera.pose_in_tool] is inverted"),
    "hand-eye w x y z": (_hand_eye_wxyz, "[camera.pose_in_tool] has its quaternion as w x y z"),
    "hand-eye in m": (_hand_eye_in_metres, "[camera.pose_in_tool] is in m"),
    "laser plane's sign": (_plane_sign, "[laser] plane_in_tool: its last number has the wrong sign"),
    "frames rotated by 180": (
        lambda path: edit_frames(path, lambda image: image[::-1, ::-1]),
        "the frames are rotated by 180°",
    ),
    "frames mirrored left to right": (
        lambda path: edit_frames(path, lambda image: image[:, ::-1]),
        "the frames are mirrored left to right",
    ),
    "frames mirrored top to bottom": (
        lambda path: edit_frames(path, lambda image: image[::-1]),
        "the frames are mirrored top to bottom",
    ),
    "frames transposed": (
        lambda path: edit_frames(path, lambda image: image.T),
        "the frames are transposed",
    ),
    "frames rotated to the left": (
        lambda path: edit_frames(path, lambda image: np.rot90(image)),
        "the frames are rotated by 90° to the left",
    ),
    "frames rotated to the right": (
        lambda path: edit_frames(path, lambda image: np.rot90(image, -1)),
        "the frames are rotated by 90° to the right",
    ),
    "joint is no butt": (
        _joint(type="butt", gap_mm=1.0, thickness_mm=3.0),
        "[joint] type = 'butt'",
    ),
    "joint is no lap": (_joint(type="lap", thickness_mm=2.0), "[joint] type = 'lap'"),
    "joint is no fillet": (_joint(type="fillet", included_angle_deg=90.0), "[joint] type = 'fillet'"),
    "surface normal into the part": (_normal_turned, "[joint] surface_normal_in_base points into the part"),
    "focal length halved": (_focal(0.5), "[camera] fx, fy: about"),
    "focal length doubled": (_focal(2.0), "[camera] fx, fy: about"),
    "image size": (
        _key("camera", "width", lambda value: value + 8),
        "[camera] width and height are not those of the frames",
    ),
    "camera of a larger image": (
        _of_larger_image,
        "[camera] is that of a larger or smaller image than the frames",
    ),
    "fy doubled": (_key("camera", "fy", lambda value: 2.0 * value), "[camera] fy is not that of this lens"),
    "seam in m": (_key("joint", "seam_in_base_mm", _metres), "[joint] seam_in_base_mm is in m"),
    "poses and seam in m": (
        _poses_and_seam_in_metres,
        "the poses and [joint] seam_in_base_mm are in m",
    ),
    "poses in cm": (_poses_in_cm, "the poses are in cm"),
    "depth in m": (_key("joint", "depth_mm", _metres), "[joint] depth_mm is in m"),
    "angle in rad": (_key("joint", "included_angle_deg", np.deg2rad), "[joint] included_angle_deg is in rad"),
    "laser's origin in m": (_key("laser", "origin_in_tool_mm", _metres), "[laser] origin_in_tool_mm is in m"),
    "stripe's sigma in m": (
        _key("laser", "stripe_sigma_mm", _metres),
        "[laser] stripe_sigma_mm: the stripe",
    ),
    "tolerance in m": (_key("tolerance", "seam_mm", _metres), "[tolerance] seam_mm is in m"),
    "sheet moved": (sheet_moved, "the whole stripe lies 9.4 px off its place: [laser]"),
    "stripe five times as wide": (
        _key("laser", "stripe_sigma_mm", lambda value: 0.2 * value),
        "[laser] stripe_sigma_mm: the stripe is 1.72 px wide, 1 sigma, 0.765 px",
    ),
    "focal length in mm": (_focal(16.2 / 2190.0), "[camera] fx, fy: about"),
}
"""Each mistake: what spoils a recording of a V-groove, and what the hint says of it."""
