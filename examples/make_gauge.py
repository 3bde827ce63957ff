"""Draw pictures of a laser stripe on a V gauge from twelve poses of a robot: make_gauge.py FOLDER.

Camera and sheet are those of examples/v_groove: the sheet stands upright, 35 mm ahead of the tool. The gauge
lies on a table that is not quite level. Each pixel's ray is cast onto the gauge's faces. The robot is off by
0.03 mm. Nothing here is arctrack's own. `poses.csv` in the folder says where the robot was, `truth.txt` what
was drawn.
"""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WIDTH, HEIGHT, FOCAL_PX, CENTRE_PX = 640, 480, 2190.0, (319.5, 239.5)
CAMERA_IN_TOOL_MM = np.array([95.0, 0.0, 130.0])
CAMERA_IN_TOOL_XYZW = (0.691123398934, -0.691123398934, -0.149493971269, 0.149493971269)
SHEET_IN_TOOL, SHEET_SIGMA_MM = np.array([1.0, 0.0, 0.0, -35.0]), 0.25
"""The sheet n.p + d = 0, mm, and 1 sigma of half its thickness."""

ANGLE_DEG, DEPTH_MM, HALF_WIDTH_MM = 90.0, 5.0, 60.0
"""The gauge: the angle between its flanks, its depth, and half its width."""

GAUGE_IN_BASE_MM, GAUGE_TURNS_DEG = np.array([400.0, 50.0, 20.0]), (0.8, -0.5, 10.0)

PEAK_DN, PEDESTAL_DN, NOISE_DN, SPECKLE = 160.0, 5.0, 1.0, 0.3
"""The stripe's peak, what lies below it, noise, and the speckle's contrast."""

ROBOT_SIGMA_MM = 0.03

POSES = (
    (0, 0, 0, 0),
    (8, 0, 0, 20),
    (-8, 0, 0, -20),
    (0, 12, 0, 40),
    (0, -12, 0, -30),
    (4, 0, 12, 10),
    (-4, 0, -12, -10),
    (0, 10, 0, 180),
    (0, 0, 12, 150),
    (6, 0, -12, 0),
    (0, 10, 12, -150),
    (-6, -10, 0, 190),
)
"""How much higher the tool is, mm, and its turns about x, y and z, deg; about the gauge's middle."""


def turned(about_x_deg: float, about_y_deg: float, about_z_deg: float) -> Array:
    """Return the rotation by these angles, about x first."""
    R = np.eye(3)
    for axis, angle in enumerate((about_x_deg, about_y_deg, about_z_deg)):
        R = cv2.Rodrigues(np.radians(angle) * np.eye(3)[axis])[0] @ R
    return R


def pose(R: Array, t: Array) -> Array:
    """Return a pose (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def rotation(x: float, y: float, z: float, w: float) -> Array:
    """Return the rotation of a unit quaternion."""
    axis = np.array([x, y, z])
    length = float(np.linalg.norm(axis))
    return np.asarray(cv2.Rodrigues(2.0 * np.arctan2(length, w) * axis / length)[0])


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion x, y, z, w of a rotation."""
    turn = cv2.Rodrigues(R)[0].ravel()
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 0.0 else turn
    x, y, z = (math.sin(0.5 * angle) * axis).tolist()
    return x, y, z, math.cos(0.5 * angle)


def v_faces(angle_deg: float, depth_mm: float) -> list[tuple[Array, Array, float, float]]:
    """Return a V's faces in its own frame: a point, a normal, and from which y to which each goes, mm.

    Its frame has x along the V, z out of the top; the root lies below y = 0.
    """
    half = math.radians(0.5 * angle_deg)
    s, c = math.sin(half), math.cos(half)
    mouth, root = depth_mm * s / c, np.array([0.0, 0.0, -depth_mm])
    top = np.zeros(3), np.array([0.0, 0.0, 1.0])
    return [
        (*top, -HALF_WIDTH_MM, -mouth),
        (root, np.array([0.0, c, s]), -mouth, 0.0),
        (root, np.array([0.0, -c, s]), 0.0, mouth),
        (*top, mouth, HALF_WIDTH_MM),
    ]


def draw(T_base_tool: Array, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Return what the camera sees at a pose of the tool."""
    T_tool_camera = pose(rotation(*CAMERA_IN_TOOL_XYZW), CAMERA_IN_TOOL_MM)
    T_base_gauge = pose(turned(*GAUGE_TURNS_DEG), GAUGE_IN_BASE_MM)
    T = np.linalg.inv(T_base_gauge) @ T_base_tool @ T_tool_camera
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - CENTRE_PX[0]) / FOCAL_PX, (v - CENTRE_PX[1]) / FOCAL_PX, np.ones(u.shape)], axis=-1)
    directions, eye = rays @ T[:3, :3].T, T[:3, 3]
    nearest, off_mm = np.full(u.shape, np.inf), np.full(u.shape, np.inf)
    normal = SHEET_IN_TOOL[:3] @ T_tool_camera[:3, :3]
    distance = SHEET_IN_TOOL[:3] @ CAMERA_IN_TOOL_MM + SHEET_IN_TOOL[3]
    for point, m, low, high in v_faces(ANGLE_DEG, DEPTH_MM):
        facing = directions @ m
        reach = (m @ (point - eye)) / np.where(facing < 0.0, facing, np.nan)
        across = eye[1] + reach * directions[..., 1]
        is_hit = (reach > 0.0) & (across >= low) & (across < high) & (reach < nearest)
        nearest[is_hit] = reach[is_hit]
        off_mm[is_hit] = reach[is_hit] * (rays[is_hit] @ normal) + distance
    light = PEAK_DN * np.exp(-0.5 * (off_mm / SHEET_SIGMA_MM) ** 2)
    light *= np.exp(SPECKLE * rng.standard_normal(light.shape) - 0.5 * SPECKLE**2)
    noisy = PEDESTAL_DN + light + rng.normal(0.0, NOISE_DN, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def main(folder: Path) -> None:
    """Draw the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    with (folder / "poses.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["file", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"])
        for n, (higher_mm, *angles) in enumerate(POSES):
            R = turned(*map(float, angles))
            stripe = GAUGE_IN_BASE_MM + np.array([*rng.uniform(-2.0, 2.0, 2), float(higher_mm)])
            T = pose(R, stripe - R @ np.array([35.0, 0.0, 0.0]))
            name = f"gauge_{n:02d}.png"
            cv2.imwrite(str(folder / name), draw(T, rng))
            stated = T[:3, 3] + ROBOT_SIGMA_MM * rng.standard_normal(3)
            table.writerow(
                [name, *(f"{value:.4f}" for value in stated), *(f"{q:.9f}" for q in quaternion(R))]
            )
    (folder / "truth.txt").write_text(
        f"v:{ANGLE_DEG:g}deg:{DEPTH_MM:g}mm\nsheet in tool: {SHEET_IN_TOOL}\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
