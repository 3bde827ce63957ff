"""How good `arctrack calibrate camera` is on pictures of boards, from the pixels on.

    python benchmarks/camera_pictures.py [--worlds WORLDS] [--seed SEED]

The ray caster of examples/make_boards.py draws a bent board before random cameras: other focal lengths,
distortions and lights, some boards inverted, some dim. Corners are found, and the lens is fitted. Printed is
by how much corners are off, the error of the projection over its sigma, and the share within its ellipse.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from calibrate_camera import mahalanobis, share
from camera_worlds import World, project
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board, Kind
from calibration.boards.detect import find_corners
from calibration.camera.calibrate import find_lens
from calibration.camera.enough import UndeterminedError
from calibration.camera.sightings import View

sys.path.append(str(Path(__file__).parents[1] / "examples"))
from make_boards import Camera, Chessboard, draw, held, rays, turned

SIZE = (640, 480)
VIEWS = 12


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    squares, offsets, missed, refused, widened = [], [], 0, 0, 0
    for n in range(options.worlds):
        rng = np.random.default_rng([options.seed, n])
        camera, light, is_inverted = draw_camera(rng), float(rng.choice([1.0, 0.15])), bool(rng.integers(2))
        board = Chessboard(8, 6, 5.0, tuple(0.05 * rng.standard_normal(2)))
        lens = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "k1")}
        world = World(SIZE, "k1", lens, (8, 6), 5.0, np.array(board.warp_mm), [], np.ones(VIEWS))
        views = []
        for view in range(VIEWS):
            lean, axis = rng.uniform(5.0, 40.0), rng.uniform(0.0, 2.0 * np.pi)
            R = turned(lean * np.cos(axis), lean * np.sin(axis), rng.uniform(-30.0, 30.0))
            t = held(camera, board, R, tuple(rng.uniform(0.3, 0.7, 2)), rng.uniform(0.4, 0.7))
            picture = draw(camera, board, R, t, rng, light)
            corners = find_corners(
                255 - picture if is_inverted else picture, Board(Kind.CHESSBOARD, 8, 6, 5.0)
            )
            world.poses.append((Rotation.from_matrix(R), t))
            truth = project(world.lens, world.corners_camera(view))
            if corners is None:
                missed += 1
                continue
            points = ordered(corners.points_px, truth)
            offsets.append(points - truth)
            views.append((view, View(f"{view}", np.arange(len(points)), points)))
        rays.cache_clear()
        try:
            result = find_lens(Board(Kind.CHESSBOARD, 8, 6, 5.0), [view for _, view in views], SIZE)
        except UndeterminedError:
            refused += 1
            continue
        used = [world.poses[index] for index, view in views if view.name in result.seen.names]
        widened += result.scatter > 1.0
        shown = World(SIZE, "k1", lens, (8, 6), 5.0, world.warp_mm, used, np.ones(len(used)))
        squares.append(mahalanobis(shown, result, rng))
    off = np.concatenate(offsets)
    print(f"{options.worlds} worlds of {VIEWS} pictures, seed {options.seed}; {refused} refused")
    print(f"boards not found, as those that are cut off: {missed} of {options.worlds * VIEWS}")
    print(f"corners: {np.sqrt(np.mean(off**2)):.3f} px RMS along x or y, mean {off.mean(axis=0)} px")
    print(f"68 % ellipse of the projection: {share(squares, 0.68):.1f} %; sigma widened in {widened}")
    print(f"RMS error over sigma: {np.sqrt(0.5 * np.mean(squares)):.2f}")


def ordered(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return corners in the truth's order: a board may be counted from its other end."""
    return min((points, points[::-1]), key=lambda each: float(np.abs(each - truth).sum()))


if __name__ == "__main__":
    main()
