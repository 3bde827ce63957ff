"""How good `arctrack calibrate hand-eye --board` is on robots and cameras whose truth is known.

    python benchmarks/calibrate_hand_eye.py [--worlds N] [--rendered N] [--mitsuba N] [--seed SEED]

Random robots show a bent board to random cameras in 8 to 25 poses, or the camera to the board. A pose is
off by 0.02 to 0.3 mm and 0.003 to 0.05 deg about each axis, a corner by 0.03 to 0.3 px. In every third
world the lens is as far off as its covariance says. In every fifth one the images of two poses are swapped.
Projection, poses and the Cramer-Rao bound are written out here. --rendered draws pictures of 15 poses each
with the renderer of examples/make_boards.py, finds their corners, and the lens in them, too. --mitsuba has
Mitsuba render them; see mitsuba_boards.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from calibration_tally import Tally
from mitsuba_boards import ROUGHNESS, Paper, draw_studio
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from calibration.boards.board import Board, BoardKind
from calibration.boards.detect import find_corners
from calibration.camera.calibrate import fit_lens
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.camera.sightings import BoardView
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from noise_model.calibration_errors import POSE
from noise_model.compiled.arrays import Float64, Integers

METHODS = {
    "Tsai": cv2.CALIB_HAND_EYE_TSAI,
    "Park": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
WORLD_METHODS = {"Shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "Li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
OURS = "arctrack"

SIZE = (1280, 960)
LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2")
LENS_SIGMA = np.array([5e-4, 5e-4, 4e-4, 4e-4, 2e-3, 6e-3])
"""1 sigma of a lens that is not the true one: focal lengths relative, the principal point in image widths."""

STEP = 1e-6
"""Steps of the bound's finite differences: rad, mm and 1."""

RENDERED_MM, RENDERED_DEG, RENDERED_POSES = 0.05, 0.01, 15
RENDERED_WARP_MM, RENDERED_MEAN_MM = (0.03, -0.02), 210.0
"""The boards' bend, and how far away they are on average."""


Renderer = Callable[[np.random.Generator, Lens, Board], Callable[[Float64], Integers]]


@dataclass(frozen=True)
class World:
    """A robot, a camera and a board; poses (4, 4) in mm, sigmas in rad, mm and px."""

    lens: Lens
    stated_lens: Lens
    lens_covariance: Float64 | None
    board: Board
    warp_mm: Float64
    T_holder_camera: Float64
    T_mount_board: Float64
    T_base_tool: Float64
    T_base_tool_true: Float64
    is_eye_to_hand: bool
    sigma: tuple[float, float, float]
    views: list[BoardView]
    swapped: tuple[int, ...]


def rigid(turn: Rotation, place: Float64) -> Float64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), place
    return T


def small(motion: Float64) -> Float64:
    """Return the pose (4, 4) of a rotation vector, rad, and a translation, mm (6,)."""
    return rigid(Rotation.from_rotvec(motion[:3]), motion[3:])


def project(lens: Lens, points: Float64) -> Float64:
    """Return where points (N, 3) are seen (N, 2), px."""
    fx, fy, cx, cy, k1, k2 = lens.values
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    return np.column_stack([fx * x * radial + cx, fy * y * radial + cy])


def bent(board: Board, warp_mm: Float64) -> Float64:
    points = board.points_mm.copy()
    a, b = (2.0 * points[:, n] / points[:, n].max() - 1.0 for n in (0, 1))
    points[:, 2] = warp_mm[0] * (1.0 - a * a) + warp_mm[1] * (1.0 - b * b)
    return points


def chained(world: World, view: int, unknown: Float64) -> Float64:
    """Return where a view's corners are seen, px, for motions of camera, board, warp and robot (20,)."""
    holder_camera = world.T_holder_camera @ small(unknown[:6])
    mount_board = world.T_mount_board @ small(unknown[6:12])
    base_tool = world.T_base_tool_true[view] @ small(unknown[14:])
    holder_mount = base_tool if world.is_eye_to_hand else np.linalg.inv(base_tool)
    T = np.linalg.inv(holder_camera) @ holder_mount @ mount_board
    points = bent(world.board, world.warp_mm + unknown[12:14])
    return project(world.lens, points @ T[:3, :3].T + T[:3, 3])


def draw_world(rng: np.random.Generator, n: int) -> World:
    """Return a random world."""
    width, height = SIZE
    focal = rng.uniform(0.9, 2.5) * width
    center = 0.5 * np.array([width - 1.0, height - 1.0]) + rng.normal(0.0, 0.02 * width, 2)
    values = np.array([focal, focal * rng.uniform(0.995, 1.005), *center, rng.normal(0.0, 0.1), 0.0])
    lens = Lens(width, height, LENS_NAMES, values)
    columns, rows = int(rng.integers(6, 12)), int(rng.integers(5, 10))
    board = Board(BoardKind.CHESSBOARD, columns, rows, float(rng.uniform(3.0, 15.0)))
    sigma = (
        np.radians(0.003 * (0.05 / 0.003) ** rng.uniform()),
        0.02 * (0.3 / 0.02) ** rng.uniform(),
        0.03 * 10.0 ** rng.uniform(),
    )
    count = int(rng.integers(8, 26))
    places = rng.normal(0.0, 100.0, 3), rng.normal(0.0, 400.0, 3)
    camera, mount = (rigid(Rotation.random(random_state=rng), place) for place in places)
    bare = World(
        lens,
        lens,
        None,
        board,
        0.005 * board.square_mm * rng.standard_normal(2),
        camera,
        mount,
        np.empty((0, 4, 4)),
        np.empty((0, 4, 4)),
        n % 2 == 1,
        sigma,
        [],
        (),
    )
    boards = [draw_board(rng, bare) for _ in range(count)]
    holder_mount = np.array([camera @ T @ np.linalg.inv(mount) for T in boards])
    true = holder_mount if bare.is_eye_to_hand else np.linalg.inv(holder_mount)
    # The robot is where it reports, times a small motion of the tool.
    spread = np.repeat(sigma[:2], 3)
    errors = [small(spread * rng.standard_normal(6)) for _ in range(count)]
    reported = np.array([T @ np.linalg.inv(error) for T, error in zip(true, errors, strict=True)])
    world = replace(bare, T_base_tool=reported, T_base_tool_true=true)
    views = []
    for view in range(count):
        image = chained(world, view, np.zeros(20))
        image = image + sigma[2] * rng.standard_normal(image.shape)
        views.append(BoardView(f"{view}", np.arange(len(image)), image))
    world = replace(world, views=views)
    if n % 3 == 2:
        lens_sigma = LENS_SIGMA * np.array([focal, focal, width, width, 1.0, 1.0])
        stated = replace(lens, values=values + lens_sigma * rng.standard_normal(6))
        world = replace(world, stated_lens=stated, lens_covariance=np.diag(lens_sigma**2))
    if n % 5 == 4:
        swapped = rng.choice(count, 2, replace=False).tolist()
        reported[swapped] = reported[swapped[::-1]]
        world = replace(world, T_base_tool=reported, swapped=tuple(swapped))
    return world


def draw_board(rng: np.random.Generator, world: World) -> Float64:
    """Return a pose at which the whole board is in view."""
    width, height = SIZE
    span = np.array([world.board.columns - 1, world.board.rows - 1]) * world.board.square_mm
    middle = np.array([*0.5 * span, 0.0])
    points = bent(world.board, world.warp_mm)
    while True:
        depth = world.lens.values[0] * span.max() / (rng.uniform(0.35, 0.8) * height)
        turn = Rotation.from_euler("XYZ", [*rng.uniform(-35, 35, 2), rng.uniform(-90, 90)], degrees=True)
        place = (rng.uniform(0.2, 0.8, 2) * [width, height] - world.lens.values[2:4]) / world.lens.values[:2]
        move = depth * np.array([*place, 1.0]) - turn.apply(middle)
        image = project(world.lens, turn.apply(points) + move)
        if ((image >= 0.0) & (image <= np.array([width, height]) - 1.0)).all():
            return rigid(turn, move)


def cramer_rao(world: World) -> Float64:
    """Return the least sigma (6,), deg and mm, that the camera's pose could have with the true noise."""
    total = np.zeros((14, 14))
    for view in range(len(world.views)):
        steps = STEP * np.eye(20)
        J = np.stack(
            [(chained(world, view, step) - chained(world, view, -step)).ravel() for step in steps], axis=1
        ) / (2.0 * STEP * world.sigma[2])
        information = J.T @ J
        information[range(14, 20), range(14, 20)] += np.repeat(world.sigma[:2], 3) ** -2.0
        shared, mixed, own = information[:14, :14], information[:14, 14:], information[14:, 14:]
        total += shared - mixed @ np.linalg.solve(own, mixed.T)
    sigma = np.sqrt(np.diag(np.linalg.inv(total))[:6])
    return np.array([*np.degrees(sigma[:3]), *sigma[3:]])


def error_of(T_holder_camera: Float64, world: World) -> Float64:
    """Return by what motion (6,) in its own frame a camera is off the true one, deg and mm."""
    T = np.linalg.inv(T_holder_camera) @ world.T_holder_camera
    return np.array([*Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True), *T[:3, 3]])


def by_opencv(world: World) -> dict[str, Float64]:
    """Return the camera's pose of each of OpenCV's methods, from its own poses of the boards."""
    fx, fy, cx, cy, k1, k2 = world.stated_lens.values
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    boards = []
    for view in world.views:
        _, turn, move = cv2.solvePnP(
            world.board.points_mm, view.points_px, matrix, np.array([k1, k2, 0.0, 0.0])
        )
        boards.append(rigid(Rotation.from_rotvec(turn.ravel()), move.ravel()))
    poses = world.T_base_tool if not world.is_eye_to_hand else np.linalg.inv(world.T_base_tool)
    seen = np.array(boards)
    results = {}
    for name, method in METHODS.items():
        R, t = cv2.calibrateHandEye(
            poses[:, :3, :3], poses[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3], method=method
        )
        results[name] = rigid(Rotation.from_matrix(R), t.ravel())
    back = np.linalg.inv(poses)
    for name, method in WORLD_METHODS.items():
        _, _, R, t = cv2.calibrateRobotWorldHandEye(
            seen[:, :3, :3], seen[:, :3, 3], back[:, :3, :3], back[:, :3, 3], method=method
        )
        results[name] = np.linalg.inv(rigid(Rotation.from_matrix(R), t.ravel()))
    return results


def judge(worlds: int, seed: int) -> None:
    tally, errors = Tally(), defaultdict[str, list[tuple[float, float, float]]](list)
    within: list[bool] = []
    robot: list[tuple[float, float]] = []
    refused = wrong_named = wrong_all = right_lost = right_all = 0
    for n in range(worlds):
        world = draw_world(np.random.default_rng([seed, n]), n)
        try:
            result = calibrated(world)
        except UndeterminedError as error:
            print(f"world {n} refused: {error}")
            refused += 1
            continue
        lost = {int(name) for name in result.left_out}
        wrong_named, wrong_all = wrong_named + len(lost & {*world.swapped}), wrong_all + len(world.swapped)
        right_lost += len(lost - {*world.swapped})
        right_all += len(world.views) - len(world.swapped)
        is_whole = world.lens_covariance is None and not world.swapped
        bound = cramer_rao(world) if is_whole else np.full(6, np.nan)
        error, half = error_of(result.T_holder_camera, world), result.half_interval()
        within += (np.abs(error) < result.half_interval(1.0 - 2.0 * norm.sf(1.0))).tolist()
        for i, name in enumerate(POSE):
            least = float(bound[i]) if is_whole else None
            tally.add(name, error[i], result.sigma[i], bool(abs(error[i]) < half[i]), least)
        robot.append(
            ((result.robot_deg / np.degrees(world.sigma[0])) ** 2, (result.robot_mm / world.sigma[1]) ** 2)
        )
        if is_whole:
            scale_mm = float(np.linalg.norm(bound[3:]))
            for name, T in {OURS: result.T_holder_camera, **by_opencv(world)}.items():
                off = error_of(T, world)
                mm = float(np.linalg.norm(off[3:]))
                errors[name].append((mm, float(np.linalg.norm(off[:3])), mm / scale_mm))
    print(f"{worlds} worlds, seed {seed}; {refused} of them refused")
    tally.report()
    print(f"68 % intervals hold {100.0 * np.mean(within):.1f} % of all six")
    turn, place = np.mean(robot, axis=0)
    print(f"robot's variance over the true one, mean: {turn:.3f} turn, {place:.3f} place")
    print(f"swapped poses named: {wrong_named} of {wrong_all}; right ones lost: {right_lost} of {right_all}")
    print_methods(errors)


def calibrated(world: World) -> HandEyeCalibration:
    return calibrate_hand_eye(
        *board_poses(world.board, world.views, world.stated_lens),
        world.T_base_tool,
        is_eye_to_hand=world.is_eye_to_hand,
        lens_covariance=world.lens_covariance,
    )


def print_methods(errors: dict[str, list[tuple[float, float, float]]]) -> None:
    print(f"{'':12} {'median mm':>10} {'95 % mm':>9} {'median deg':>11} {'RMS over the bound':>19}")
    for name, rows in errors.items():
        mm, deg, ratio = np.array(rows).T
        print(
            f"{name:12} {np.median(mm):10.4f} {np.quantile(mm, 0.95):9.3f} {np.median(deg):11.4f} "
            f"{np.sqrt(np.mean(ratio**2)):19.2f}"
        )


def ray_caster(rng: np.random.Generator, lens: Lens, board: Board) -> Callable[[Float64], Integers]:
    """Return what draws a board at a pose in the camera: the renderer of the examples."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from make_boards import Camera, Chessboard, draw

    camera = Camera(lens.width, lens.height, **dict(zip(lens.names, lens.values.tolist(), strict=True)))
    drawn = Chessboard(board.columns, board.rows, board.square_mm, RENDERED_WARP_MM)
    return lambda T: draw(camera, drawn, T[:3, :3], T[:3, 3], rng)


def path_tracer(rng: np.random.Generator, lens: Lens, board: Board) -> Callable[[Float64], Integers]:
    """Return what draws a board at a pose in the camera: Mitsuba."""
    values = dict(zip(lens.names, lens.values.tolist(), strict=True))
    studio = draw_studio(rng, (lens.width, lens.height), values, RENDERED_MEAN_MM)
    paper = Paper(board, np.array(RENDERED_WARP_MM), float(rng.uniform(*ROUGHNESS)))
    return lambda T: studio.picture(studio.light_e(paper, T[:3, :3], T[:3, 3]))


def judge_rendered(worlds: int, seed: int, renderer: Renderer) -> None:
    """Draw pictures, find corners and lens in them, and print how far the camera's place is off."""
    rows: dict[str, list[tuple[float, float, Float64]]] = {"lens as drawn": [], "lens from the pictures": []}
    for n in range(worlds):
        rng = np.random.default_rng([seed, 1000 + n])
        board = Board(BoardKind.CHESSBOARD, 9, 6, 5.0)
        lens = Lens(640, 480, LENS_NAMES, np.array([1500.0, 1502.0, 322.0, 236.0, -0.2, 0.1]))
        picture = renderer(rng, lens, board)
        T_holder_camera = rigid(Rotation.random(random_state=rng), rng.normal(0.0, 80.0, 3))
        T_mount_board = rigid(Rotation.random(random_state=rng), rng.normal(0.0, 400.0, 3))
        poses, views, drawn_boards = [], [], []
        while len(views) < RENDERED_POSES:
            turn = Rotation.from_euler("XYZ", [*rng.uniform(-30, 30, 2), rng.uniform(-90, 90)], degrees=True)
            depth = 1500.0 * 40.0 / (rng.uniform(0.45, 0.75) * 480.0)
            place = np.array([*rng.uniform(-0.03, 0.03, 2), 1.0])
            T = rigid(turn, depth * place - turn.apply([20.0, 12.5, 0.0]))
            found = find_corners(picture(T), board)
            if found is None:
                continue
            views.append(BoardView(f"{len(views)}", found.corners, found.points_px))
            drawn_boards.append(T)
            true = T_mount_board @ np.linalg.inv(T) @ np.linalg.inv(T_holder_camera)
            off = np.repeat([np.radians(RENDERED_DEG), RENDERED_MM], 3) * rng.standard_normal(6)
            poses.append(true @ np.linalg.inv(small(off)))
        camera_found = fit_lens(board, views, (lens.width, lens.height))
        k = len(camera_found.scene.lens.names)
        for name, used, covariance in (
            ("lens as drawn", lens, None),
            ("lens from the pictures", camera_found.scene.lens, camera_found.covariance[:k, :k]),
        ):
            result = calibrate_hand_eye(
                *board_poses(board, views, used), np.array(poses), lens_covariance=covariance
            )
            off = T_holder_camera[:3, :3].T @ (result.T_holder_camera[:3, 3] - T_holder_camera[:3, 3])
            # A lens that is off sees the board elsewhere, and the camera's place makes up for it.
            middle = np.append(board.points_mm.mean(axis=0), 1.0)
            seen = result.refined.boards.scene.T_camera_board @ middle @ result.T_holder_camera.T
            true = np.array([drawn_boards[int(kept)] for kept in result.names]) @ middle @ T_holder_camera.T
            rows[name].append(
                (
                    float(np.linalg.norm(off)),
                    float(np.linalg.norm((seen - true).mean(axis=0))),
                    off / result.sigma[3:],
                )
            )
    print(
        f"{worlds} rendered worlds of {RENDERED_POSES} pictures; robot: {RENDERED_MM} mm, {RENDERED_DEG} deg"
    )
    print(
        f"{'':24} {'camera, median and most mm':>28} {'board amid the poses':>24} {'camera over sigma':>18}"
    )
    for name, each in rows.items():
        place, board_off = (np.array([row[n] for row in each]) for n in (0, 1))
        z = np.sqrt(np.mean(np.square([row[2] for row in each])))
        print(
            f"{name:24} {np.median(place):20.3f} {place.max():7.3f} {np.median(board_off):16.3f} "
            f"{board_off.max():7.3f} {z:18.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=450)
    parser.add_argument("--rendered", type=int, default=0, help="worlds whose pictures are drawn")
    parser.add_argument("--mitsuba", type=int, default=0, help="worlds whose pictures Mitsuba renders")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    start = time.process_time()
    if options.worlds:
        judge(options.worlds, options.seed)
    if options.rendered:
        judge_rendered(options.rendered, options.seed, ray_caster)
    if options.mitsuba:
        judge_rendered(options.mitsuba, options.seed, path_tracer)
    print(f"{time.process_time() - start:.0f} s of CPU")


if __name__ == "__main__":
    main()
