"""How good `arctrack calibrate camera` is on pictures of boards, from the pixels on.

    python benchmarks/camera_pictures.py [--worlds WORLDS] [--mitsuba WORLDS] [--seed SEED]

The ray caster of examples/make_boards.py draws a bent board before random cameras: other focal lengths,
distortions and lights, some boards inverted, some dim. Corners are found, and the lens is fitted. Printed is
by how much corners are off, the errors of lens and projection over their sigmas, and the share within the
projection's ellipse. --mitsuba has Mitsuba render glossy boards in a lit room instead; see mitsuba_boards.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from calibrate_camera import mahalanobis, share
from camera_worlds import World, project
from mitsuba_boards import ROUGHNESS, Paper, draw_studio
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board, BoardKind
from calibration.boards.detect import find_corners
from calibration.camera.calibrate import fit_lens
from calibration.camera.enough import UndeterminedError
from calibration.camera.sightings import BoardView

sys.path.append(str(Path(__file__).parents[1] / "examples"))
from make_boards import Camera, Chessboard, draw, held, rays, turned

SIZE = (640, 480)
VIEWS, MITSUBA_VIEWS = 12, 15
LENS = ("fx", "fy", "cx", "cy", "k1")

Pictures = Callable[[Chessboard, np.ndarray, np.ndarray], np.ndarray]
"""Draws a board that a rotation and a translation, mm, take to the camera."""


def draw_camera(rng: np.random.Generator) -> Camera:
    focal = float(np.exp(rng.uniform(np.log(600.0), np.log(2200.0))))
    corner = 400.0 / focal
    k1 = float(rng.choice([0.0, 0.06 * rng.standard_normal() / corner**2]))
    return Camera(
        *SIZE,
        focal,
        focal * (1.0 + 0.002 * rng.standard_normal()),
        319.5 + 8.0 * rng.standard_normal(),
        239.5 + 8.0 * rng.standard_normal(),
        k1=k1,
    )


def drawn(rng: np.random.Generator, camera: Camera) -> Pictures:
    """Return what draws boards before a camera: the examples' ray caster."""
    light, is_inverted = float(rng.choice([1.0, 0.15])), bool(rng.integers(2))

    def picture(board: Chessboard, R: np.ndarray, t: np.ndarray) -> np.ndarray:
        grey = draw(camera, board, R, t, rng, light)
        return 255 - grey if is_inverted else grey

    return picture


def rendered(rng: np.random.Generator, camera: Camera) -> Pictures:
    """Return what renders boards before a camera: Mitsuba."""
    lens = {name: getattr(camera, name) for name in LENS}
    # Boards are 40 mm long and take 40 to 70 % of the image's height.
    distance_mm = camera.fx * 40.0 / (0.52 * camera.height)
    studio = draw_studio(rng, SIZE, lens, distance_mm)
    roughness = float(rng.uniform(*ROUGHNESS))

    def picture(board: Chessboard, R: np.ndarray, t: np.ndarray) -> np.ndarray:
        stated = Board(BoardKind.CHESSBOARD, board.columns, board.rows, board.square_mm)
        return studio.picture(studio.light_e(Paper(stated, np.array(board.warp_mm), roughness), R, t))

    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=40)
    parser.add_argument("--mitsuba", type=int, default=0, help="worlds that Mitsuba renders")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if options.worlds:
        judge(options.worlds, options.seed, VIEWS, drawn)
    if options.mitsuba:
        judge(options.mitsuba, options.seed, MITSUBA_VIEWS, rendered)


def judge(
    worlds: int, seed: int, n_views: int, pictures: Callable[[np.random.Generator, Camera], Pictures]
) -> None:
    """Calibrate random cameras by pictures, and print what is off."""
    squares, offsets, missed, refused, widened = [], [], 0, 0, 0
    over_sigma: dict[str, list[float]] = {name: [] for name in LENS[:4]}
    for n in range(worlds):
        rng = np.random.default_rng([seed, n])
        camera = draw_camera(rng)
        picture = pictures(rng, camera)
        board = Chessboard(8, 6, 5.0, tuple(0.05 * rng.standard_normal(2)))
        lens = {name: getattr(camera, name) for name in LENS}
        world = World(SIZE, "k1", lens, (8, 6), 5.0, np.array(board.warp_mm), [], np.ones(n_views))
        views = []
        for view in range(n_views):
            lean, axis = rng.uniform(5.0, 40.0), rng.uniform(0.0, 2.0 * np.pi)
            R = turned(lean * np.cos(axis), lean * np.sin(axis), rng.uniform(-30.0, 30.0))
            t = held(camera, board, R, tuple(rng.uniform(0.3, 0.7, 2)), rng.uniform(0.4, 0.7))
            corners = find_corners(picture(board, R, t), Board(BoardKind.CHESSBOARD, 8, 6, 5.0))
            world.poses.append((Rotation.from_matrix(R), t))
            truth = project(world.lens, world.corners_camera(view))
            if corners is None:
                missed += 1
                continue
            points = ordered(corners.points_px, truth)
            offsets.append(points - truth)
            views.append((view, BoardView(f"{view}", np.arange(len(points)), points)))
        rays.cache_clear()
        try:
            result = fit_lens(Board(BoardKind.CHESSBOARD, 8, 6, 5.0), [view for _, view in views], SIZE)
        except UndeterminedError:
            refused += 1
            continue
        used = [world.poses[index] for index, view in views if view.name in result.seen.names]
        widened += result.scatter > 1.0
        shown = World(SIZE, "k1", lens, (8, 6), 5.0, world.warp_mm, used, np.ones(len(used)))
        squares.append(mahalanobis(shown, result, rng))
        for name, value, sigma in zip(LENS[:4], result.scene.lens.values, result.sigma, strict=False):
            over_sigma[name].append((value - lens[name]) / sigma)
    off = np.concatenate(offsets)
    print(f"{worlds} worlds of {n_views} pictures, seed {seed}; {refused} refused")
    print(f"boards not found, as those that are cut off: {missed} of {worlds * n_views}")
    print(f"corners: {np.sqrt(np.mean(off**2)):.3f} px RMS along x or y, mean {off.mean(axis=0)} px")
    for name, z in over_sigma.items():
        print(f"{name}: error over sigma {np.sqrt(np.mean(np.square(z))):.2f} RMS, {np.mean(z):+.2f} mean")
    print(f"68 % ellipse of the projection: {share(squares, 0.68):.1f} %; sigma widened in {widened}")
    print(f"RMS error over sigma: {np.sqrt(0.5 * np.mean(squares)):.2f}")


def ordered(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return corners in the truth's order: a board may be counted from its other end."""
    return min((points, points[::-1]), key=lambda each: float(np.abs(each - truth).sum()))


if __name__ == "__main__":
    main()
