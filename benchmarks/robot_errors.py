"""Are repeatable errors of a robot found where there are some, and refused where there are none?

    python benchmarks/robot_errors.py [--worlds N] [--seed SEED] [--error none|joints|sag] [--size DEG]
        [--poses N] [--no-angles]

A six-axis arm shows a board to a camera in its hand, or the camera to a board. Its kinematics are written out
here. Each pose is off by noise, and by the error: offsets of joints 2 to 5, or a sag of the tool as it leans.
Printed are the models taken, how the seam's place in the tool, 300 mm before the camera, is off and covered,
and what it would be without any model.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass

import numpy as np
from calibrate_hand_eye import LENS_NAMES, SIZE, bent, project, rigid, small
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board, BoardKind
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.camera.sightings import BoardView
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from calibration.rigid import cross_matrices
from noise_model.compiled.arrays import Float64

AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], dtype=float)
POINTS_MM = np.array(
    [[0, 0, 0], [150, 0, 475], [150, 0, 1075], [150, 0, 1195], [870, 0, 1195], [955, 0, 1195]], dtype=float
)
HOME = rigid(Rotation.from_euler("y", 90, degrees=True), np.array([955.0, 0.0, 1195.0]))
"""Axes of an arm of 1.4 m that stands upright, points on them, and its flange, at angles of 0."""

T_FLANGE_CAMERA = rigid(Rotation.from_euler("xyz", [4, -6, 90], degrees=True), np.array([-80.0, 10.0, 60.0]))
SEAM_CAMERA_MM = np.array([10.0, -5.0, 300.0])
BOARD = Board(BoardKind.CHESSBOARD, 9, 6, 15.0)
LENS = Lens(*SIZE, LENS_NAMES, np.array([1700.0, 1702.0, 640.0, 480.0, -0.1, 0.05]))
NOISE_DEG, NOISE_MM, CORNER_PX = 0.01, 0.05, 0.05


def flange(q: Float64) -> Float64:
    """Return the flange's pose (4, 4) at joint angles (6,), rad."""
    T = np.eye(4)
    for axis, point, angle in zip(AXES, POINTS_MM, q, strict=True):
        turn = Rotation.from_rotvec(angle * axis)
        T = T @ rigid(turn, point - turn.apply(point))
    return np.asarray(T @ HOME)


def joint_angles(T: Float64) -> Float64 | None:
    """Return joint angles that reach a pose, with the wrist bent; None where there are none near by."""

    def off(q: Float64) -> Float64:
        E = np.linalg.inv(T) @ flange(q)
        return np.concatenate([500.0 * Rotation.from_matrix(E[:3, :3]).as_rotvec(), E[:3, 3]])

    start = np.array([np.arctan2(T[1, 3], T[0, 3]), 0.3, 0.2, 0.0, 1.0, 0.0])
    found = least_squares(off, start, method="lm")
    return np.asarray(found.x) if found.cost < 1e-12 and np.abs(found.x).max() < 3.0 else None


@dataclass(frozen=True)
class ArmWorld:
    """Poses as reported (V, 4, 4), joint angles (V, 6), rad, and corners; the true offsets, deg."""

    T_base_tool: Float64
    joint_rad: Float64
    views: list[BoardView]
    offsets_deg: Float64


def draw_arm(rng: np.random.Generator, poses: int, error: str, size_deg: float) -> ArmWorld:
    """Return a random arm whose repeatable error has the size, 1 sigma."""
    T_base_board = rigid(
        Rotation.from_euler(
            "xyz", [180 + rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(-180, 180)], True
        ),
        np.array([rng.uniform(650, 850), rng.uniform(-250, 250), rng.uniform(0, 250)]),
    )
    offsets = np.zeros(6)
    offsets[1:5] = size_deg * rng.standard_normal(4) * (error == "joints")
    sag = size_deg * rng.standard_normal((3, 3)) * (error == "sag")
    points = bent(BOARD, 0.01 * rng.standard_normal(2))
    reported, angles, views = [], [], []
    while len(views) < poses:
        lean = Rotation.from_euler("XYZ", [*rng.uniform(-30, 30, 2), rng.uniform(-60, 60)], True)
        place = np.array([*rng.uniform(-40, 40, 2), rng.uniform(280, 420)])
        T_camera_board = rigid(lean, place - lean.apply([60.0, 37.5, 0.0]))
        true = T_base_board @ np.linalg.inv(T_camera_board) @ np.linalg.inv(T_FLANGE_CAMERA)
        # xi: the tool is where it is reported, times a small motion.
        noise = np.repeat([np.radians(NOISE_DEG), NOISE_MM], 3) * rng.standard_normal(6)
        leaning = np.radians(sag @ (true[2, :3] - [0.0, 0.0, -1.0]))
        meant = true @ np.linalg.inv(small(noise)) @ np.linalg.inv(small(np.append(leaning, np.zeros(3))))
        q = joint_angles(meant)
        if q is None:
            continue
        q = q - np.radians(offsets)
        image = project(LENS, points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])
        image = image + CORNER_PX * rng.standard_normal(image.shape)
        angles.append(np.radians(np.round(np.degrees(q), 3)))
        reported.append(flange(q))
        views.append(BoardView(f"{len(views)}", np.arange(len(image)), image))
    return ArmWorld(np.array(reported), np.array(angles), views, offsets)


def calibrated(world: ArmWorld, *, with_angles: bool) -> HandEyeCalibration:
    return calibrate_hand_eye(
        *board_poses(BOARD, world.views, LENS),
        world.T_base_tool,
        joint_rad=world.joint_rad if with_angles else None,
    )


def seam_error(result: HandEyeCalibration) -> tuple[Float64, Float64]:
    """Return the seam's error (3,) in the tool, and its sigma (3,), mm."""
    T = result.T_holder_camera
    off = (T - T_FLANGE_CAMERA)[:3] @ np.append(SEAM_CAMERA_MM, 1.0)
    per_pose = T[:3, :3] @ np.hstack([-cross_matrices(SEAM_CAMERA_MM[np.newaxis])[0], np.eye(3)])
    per_pose[:, :3] *= np.pi / 180.0
    return off, np.sqrt(np.diag(per_pose @ result.covariance @ per_pose.T))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--error", choices=("none", "joints", "sag"), default="joints")
    parser.add_argument("--size", type=float, default=0.1)
    parser.add_argument("--poses", type=int, default=15)
    parser.add_argument("--no-angles", action="store_true")
    options = parser.parse_args()
    taken, refused = Counter[str](), 0
    errors, sigmas, offsets, left = [], [], [], 0
    held = []
    for n in range(options.worlds):
        world = draw_arm(np.random.default_rng([options.seed, n]), options.poses, options.error, options.size)
        try:
            result = calibrated(world, with_angles=not options.no_angles)
        except UndeterminedError as error:
            print(f"world {n} refused: {error}")
            refused += 1
            continue
        taken[result.robot_error.name] += 1
        left += len(result.left_out)
        held.append([result.robot_errors[0].rms_mm, result.robot_error.rms_mm])
        off, sigma = seam_error(result)
        errors.append(off)
        sigmas.append(sigma)
        if result.robot_error.name == "joints":
            found, spread = result.joint_offsets
            offsets.append((found - world.offsets_deg[1 : 1 + len(found)]) / spread)
    off, sigma = np.array(errors), np.array(sigmas)
    print(f"{options.worlds} worlds, {options.error} {options.size} deg: {refused} refused, {left} left out")
    print("taken:", dict(taken), "; held-out boards without and with, mm:", np.median(held, axis=0).round(3))
    print(
        "seam in the tool: RMS error", np.sqrt(np.mean(off**2, axis=0)).round(3), "mm, median sigma", end=" "
    )
    print(np.median(sigma, axis=0).round(3), "covered", np.mean(np.abs(off) < 1.96 * sigma, axis=0).round(3))
    if offsets:
        z = np.array(offsets)
        print("joint offsets over sigma: RMS", np.sqrt(np.mean(z**2, axis=0)).round(2))


if __name__ == "__main__":
    main()
