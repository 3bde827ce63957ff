"""Random cameras, boards and corners whose truth is known, drawn without the estimator's code.

The projection is written out here from OpenCV's documentation. Boards bend, corners scatter, some are wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64

LENSES: dict[str, dict[str, float]] = {
    "none": {},
    "k1": {"k1": 0.2},
    "k1 k2": {"k1": 0.2, "k2": 0.2},
    "k1 k2 p1 p2": {"k1": 0.2, "k2": 0.2, "p1": 0.002, "p2": 0.002},
    "k1 k2 p1 p2 k3": {"k1": 0.2, "k2": 0.2, "p1": 0.002, "p2": 0.002, "k3": 0.2},
}
"""The distortions that are drawn, and 1 sigma of each coefficient at the image's corner, r = 1."""


FAR, MIN_SLOPE = 1.5, 0.2
"""A lens must not fold up to so many times the radius of the image's corner, nor come near to it."""


@dataclass(frozen=True)
class World:
    """A camera, a board, and where it was held.

    Parameters
    ----------
    size : tuple of int
        The image's width and height, px.
    order : str
        The kind of distortion, of `LENSES`.
    lens : dict
        fx, fy, cx, cy and OpenCV's distortion coefficients.
    counts : tuple of int
        The board's inner corners along x and y.
    square_mm : float
        Its squares' side.
    warp_mm : array (2,)
        Its rise in the middle along x and y.
    poses : list of (Rotation, array (3,))
        Where it was: board to camera, mm.
    sigma_px : array (V,)
        1 sigma of the corners in each image.
    print_mm : array (n, 2)
        How far each corner is off where the board states it.
    """

    size: tuple[int, int]
    order: str
    lens: dict[str, float]
    counts: tuple[int, int]
    square_mm: float
    warp_mm: Float64
    poses: list[tuple[Rotation, Float64]]
    sigma_px: Float64
    print_mm: Float64 | float = 0.0

    def board_mm(self) -> Float64:
        """Return the bent board's corners (n, 3), mm, row by row."""
        x, y = np.meshgrid(np.linspace(-1.0, 1.0, self.counts[0]), np.linspace(-1.0, 1.0, self.counts[1]))
        z = self.warp_mm[0] * (1.0 - x**2) + self.warp_mm[1] * (1.0 - y**2)
        across = 0.5 * (self.counts[0] - 1) * self.square_mm * (x + 1.0)
        down = 0.5 * (self.counts[1] - 1) * self.square_mm * (y + 1.0)
        points = np.column_stack([across.ravel(), down.ravel(), z.ravel()])
        points[:, :2] += self.print_mm
        return points

    def corners_camera(self, view: int) -> Float64:
        """Return an image's corners (n, 3) in the camera frame, mm."""
        turn, move = self.poses[view]
        return np.asarray(turn.apply(self.board_mm()) + move)


def project(lens: dict[str, float], points: Float64) -> Float64:
    """Return where points (N, 3), mm, are seen (N, 2), px: OpenCV's formula of the pinhole camera model."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    k = [lens.get(f"k{n}", 0.0) for n in range(1, 7)]
    p1, p2 = lens.get("p1", 0.0), lens.get("p2", 0.0)
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    if "tau_x" in lens:
        u, v = tilted(u, v, lens["tau_x"], lens["tau_y"])
    return np.column_stack([lens["fx"] * u + lens["cx"], lens["fy"] * v + lens["cy"]])


def tilted(u: Float64, v: Float64, tau_x: float, tau_y: float) -> tuple[Float64, Float64]:
    """Return where a tilted sensor sees what a straight one sees: OpenCV's tilted model, angles in rad."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    R = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]]
    )
    shifted = np.array([[R[2, 2], 0.0, -R[0, 2]], [0.0, R[2, 2], -R[1, 2]], [0.0, 0.0, 1.0]]) @ R
    x, y, w = shifted @ np.stack([u, v, np.ones_like(u)])
    return x / w, y / w


def folds(lens: dict[str, float], far: float) -> bool:
    """Return whether a lens shows what is further out no further out, up to r = `far`."""
    r2 = np.linspace(0.0, far, 50) ** 2
    k1, k2, k3 = (lens.get(name, 0.0) for name in ("k1", "k2", "k3"))
    return bool((1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))).min() < MIN_SLOPE)


def draw_world(rng: np.random.Generator, order: str, views: int | None = None) -> World:
    """Return a random world whose lens has this distortion."""
    size = [(640, 480), (1280, 1024), (1700, 1200), (1024, 1024)][rng.integers(4)]
    diagonal = float(np.hypot(*size))
    focal = diagonal * np.exp(rng.uniform(np.log(0.7), np.log(3.0)))
    lens = {
        "fx": focal,
        "fy": focal * (1.0 + 0.003 * rng.standard_normal()),
        "cx": 0.5 * size[0] + 0.02 * size[0] * rng.standard_normal(),
        "cy": 0.5 * size[1] + 0.02 * size[1] * rng.standard_normal(),
    }
    corner = 0.5 * diagonal / focal
    while not lens.keys() >= LENSES[order].keys() or folds(lens, FAR * corner):
        for name, sigma in LENSES[order].items():
            power = {"k1": 2, "k2": 4, "k3": 6}.get(name, 1)
            # At the image's corner every term moves the image by a few per cent at most.
            lens[name] = 0.15 * sigma * rng.standard_normal() / corner**power
    counts = (int(rng.integers(6, 12)), int(rng.integers(5, 10)))
    square_mm = float(rng.choice([3.0, 5.0, 10.0, 30.0]))
    views = int(rng.integers(10, 26)) if views is None else views
    noise = float(np.exp(rng.uniform(np.log(0.03), np.log(0.3))))
    spread = float(rng.choice([0.0, 0.4]))
    bare = World(
        size,
        order,
        lens,
        counts,
        square_mm,
        0.01 * square_mm * rng.standard_normal(2),
        [],
        noise * np.exp(spread * rng.standard_normal(views)),
    )
    while len(bare.poses) < views:
        pose = _draw_pose(rng, bare)
        if pose is not None:
            bare.poses.append(pose)
    return bare


def _draw_pose(rng: np.random.Generator, world: World) -> tuple[Rotation, Float64] | None:
    """Return a pose at which the whole board is in view, None if the one drawn is not."""
    width, height = world.size
    span_mm = (max(world.counts) - 1) * world.square_mm
    depth = world.lens["fx"] * span_mm / (rng.uniform(0.3, 0.8) * min(width, height))
    axis = rng.uniform(0.0, 2.0 * np.pi)
    lean = np.radians(rng.uniform(0.0, 45.0))
    turn = Rotation.from_rotvec(lean * np.array([np.cos(axis), np.sin(axis), 0.0]))
    turn = turn * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    middle = world.board_mm().mean(axis=0)
    place = rng.uniform(0.0, 1.0, 2) * [width, height]
    ray = [
        (place[0] - world.lens["cx"]) / world.lens["fx"],
        (place[1] - world.lens["cy"]) / world.lens["fy"],
        1.0,
    ]
    move = depth * np.array(ray) - turn.apply(middle)
    points = turn.apply(world.board_mm()) + move
    if points[:, 2].min() < 0.2 * depth:
        return None
    image = project(world.lens, points)
    inside = (image >= 0.0) & (image <= np.array([width, height]) - 1.0)
    return (turn, move) if inside.all() else None


def draw_corners(
    rng: np.random.Generator, world: World, wrong_share: float = 0.0
) -> tuple[list[Float64], list[Sequence[int]]]:
    """Return each image's corners (n, 2), px, and which of them are wrong by some px."""
    images, wrong = [], []
    for view, sigma in enumerate(world.sigma_px):
        points = project(world.lens, world.corners_camera(view))
        points = points + sigma * rng.standard_normal(points.shape)
        chosen = np.flatnonzero(rng.random(len(points)) < wrong_share)
        points[chosen] += rng.uniform(2.0, 8.0) * rng.choice([-1.0, 1.0], (len(chosen), 2))
        images.append(points)
        wrong.append(chosen.tolist())
    return images, wrong
