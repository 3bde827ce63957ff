"""Bundle adjustment: lens, the board's shape and its poses that explain the corners best.

Residuals are those of the image points over their sigma. Poses move by a small rotation and translation in
the camera frame, so that no pose is singular. Steps are Levenberg's and Marquardt's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.lens import Lens
from calibration.camera.normal_equations import NormalEquations
from calibration.camera.sightings import Sightings
from calibration.rigid import motions, transform_each
from noise_model.compiled.arrays import Float64

MAX_ROUNDS = 100
SETTLED = 1e-9
"""A round that lowers the cost by a smaller share is the last."""

FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-4, 1e-9, 1e12
WARP = ("warp_x", "warp_y")
"""Shared unknowns other than the lens: the board's warp along its columns and rows, mm."""


@dataclass(frozen=True)
class BoardScene:
    """Model of the corners: a lens, the board's shape, and its pose in each image.

    `warp_mm` (2,) is the board's rise in its middle from bending along the columns and along the rows,
    `T_camera_board` (V, 4, 4) its poses, mm, and `print_mm` (columns * rows, 2) each corner's printing error
    along x and y.
    """

    lens: Lens
    warp_mm: Float64
    T_camera_board: Float64
    print_mm: Float64

    def points_camera(self, seen: Sightings) -> Float64:
        """Return the corners (N, 3) in the camera frame, mm."""
        board = seen.flat_mm.copy()
        board[:, :2] += self.print_mm[seen.corner]
        board[:, 2] += seen.bulge @ self.warp_mm
        return transform_each(self.T_camera_board[seen.view], board)

    def residuals(self, seen: Sightings) -> Float64:
        """Return observed less predicted image points (N, 2), px."""
        return np.asarray(seen.points_px - self.lens.project(self.points_camera(seen)))

    def rms_px(self, seen: Sightings) -> float:
        """Return the RMS distance of observed from predicted image points, px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals(seen) ** 2, axis=1))))

    def select_views(self, chosen: list[int]) -> BoardScene:
        """Return the scene of some of the images."""
        return replace(self, T_camera_board=self.T_camera_board[chosen])

    def moved(self, shared: Float64, motion: Float64) -> BoardScene:
        """Return the scene after a step of each board (V, 6), and of what is shared.

        This is the lens and the warp (n + 2,), or these and the corners' places on the board.
        """
        n = len(self.lens.values)
        lens = replace(self.lens, values=self.lens.values + shared[:n])
        places = shared[n + 2 :].reshape(-1, 2) if len(shared) > n + 2 else 0.0
        return BoardScene(
            lens,
            self.warp_mm + shared[n : n + 2],
            motions(motion) @ self.T_camera_board,
            self.print_mm + places,
        )


def linearise(
    scene: BoardScene, seen: Sightings, weight: Float64, *, with_print: bool = False
) -> NormalEquations:
    """Return the normal equations at a scene, without priors of lens and printing errors.

    `weight` (N,) is 1 / sigma of each corner, 1/px. With `with_print` the printing errors are unknowns, after
    lens and warp.
    """
    points = scene.points_camera(seen)
    image, per_motion, per_lens = scene.lens.project_with_jacobian(points)
    normals = scene.T_camera_board[seen.view][:, :3, 2]
    lift = np.einsum("nij,nj->ni", per_motion[:, :, 3:], normals)
    per_shared = np.concatenate([per_lens, lift[:, :, None] * seen.bulge[:, None, :]], axis=2)
    if with_print:
        per_place = np.zeros((len(seen), 2, len(scene.print_mm), 2))
        axes = scene.T_camera_board[seen.view][:, :3, :2]
        per_place[np.arange(len(seen)), :, seen.corner] = per_motion[:, :, 3:] @ axes
        per_shared = np.concatenate([per_shared, per_place.reshape(len(seen), 2, -1)], axis=2)
    w = weight[:, None, None]
    residual = (seen.points_px - image) * weight[:, None]
    return NormalEquations.of(seen.slices, per_shared * w, per_motion * w, residual)


def adjust(
    scene: BoardScene,
    seen: Sightings,
    weight: Float64,
    *,
    poses_only: bool = False,
    print_sigma_mm: float = 0.0,
) -> BoardScene:
    """Return the scene of least squares, with the prior on the lens' distortion.

    `scene` is the start and `weight` (N,) 1 / sigma of each corner, 1/px. `poses_only` holds lens and warp.
    `print_sigma_mm` is 1 sigma of the printing errors; 0 holds them. Iteration ends where no step lowers the
    sum of squares.
    """
    prior = prior_precision(scene, print_sigma_mm)
    cost, damping = _cost(scene, seen, weight, prior), FIRST_DAMPING
    for _ in range(MAX_ROUNDS):
        equations = _with_prior(scene, seen, weight, prior)
        while True:
            moved = _step(scene, equations.damped(damping), poses_only)
            new_cost = np.inf if moved is None else _cost(moved, seen, weight, prior)
            if new_cost <= cost:
                break
            damping *= 10.0
            if damping > MAX_DAMPING:
                return scene
        if moved is None:
            return scene
        gained, scene, cost = cost - new_cost, moved, new_cost
        damping = max(damping * 0.1, MIN_DAMPING)
        if gained <= SETTLED * cost:
            break
    return scene


def prior_precision(scene: BoardScene, print_sigma_mm: float = 0.0) -> Float64:
    """Return 1 / sigma² (m,) of what is known of lens, warp and print beforehand; a print of 0 mm is held."""
    places = np.full(scene.print_mm.size, print_sigma_mm**-2) if print_sigma_mm > 0.0 else np.empty(0)
    return np.concatenate([scene.lens.prior_precision(), np.zeros(len(WARP)), places])


def with_prior(
    scene: BoardScene, seen: Sightings, weight: Float64, print_sigma_mm: float = 0.0
) -> NormalEquations:
    """Return the normal equations at a scene with what is known of lens and print beforehand.

    The corners' places on the board are among the unknowns where `print_sigma_mm` is not 0.
    """
    return _with_prior(scene, seen, weight, prior_precision(scene, print_sigma_mm))


def _with_prior(scene: BoardScene, seen: Sightings, weight: Float64, prior: Float64) -> NormalEquations:
    n = len(scene.lens.values) + len(WARP)
    equations = linearise(scene, seen, weight, with_print=len(prior) > n)
    return equations.with_prior(prior, shared_values(scene)[: len(prior)])


def shared_values(scene: BoardScene) -> Float64:
    """Return the values of all that is shared: lens, warp and the corners' places on the board."""
    return np.concatenate([scene.lens.values, scene.warp_mm, scene.print_mm.ravel()])


def _step(scene: BoardScene, equations: NormalEquations, poses_only: bool) -> BoardScene | None:
    try:
        if poses_only:
            return scene.moved(np.zeros(len(scene.lens.values) + 2), equations.motion_step())
        return scene.moved(*equations.step())
    except np.linalg.LinAlgError:
        return None


def _cost(scene: BoardScene, seen: Sightings, weight: Float64, prior: Float64) -> float:
    # A board behind the camera, or a focal length below 0, explains nothing.
    points = scene.points_camera(seen)
    if not (points[:, 2] > 0.0).all() or not (scene.lens.values[:2] > 0.0).all():
        return float("inf")
    residual = (seen.points_px - scene.lens.project(points)) * weight[:, None]
    cost = float(np.sum(residual**2) + np.sum(prior * shared_values(scene)[: len(prior)] ** 2))
    return cost if np.isfinite(cost) else float("inf")
