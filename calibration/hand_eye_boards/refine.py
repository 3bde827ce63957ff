"""The joint refinement by reprojection: camera, board, warp, and where the robot really was, with its noise.

The boards' poses in the camera are free, and the robot's poses predict them with an error of unknown
size. So the sum of squares is that of the corners over their noise and of the robot's errors over theirs.
Each round linearises it at the boards' present poses T. With f a small motion of a board, g and D the
corners' pull on it and its information, and eta how far T is off what the chain predicts, the corners
alone would move the board by D^-1 g:

    e = eta + D^-1 g

Camera, board and the coefficients of a repeatable error follow by least squares of e (`variances`). With W =
(M Sigma M')^-1, and K the derivatives by all three, the boards follow by (D + W) f = g - B' dw + W (K step -
eta). The lens is held.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.adjustment import WARP, BoardScene, adjust, linearise
from calibration.camera.noise import corner_sigmas_px
from calibration.camera.normal_equations import NormalEquations
from calibration.camera.sightings import Sightings
from calibration.hand_eye_boards.chain import POSES, Chain
from calibration.hand_eye_boards.variances import PoseErrors, VarianceSolution, robot_sigma, solve
from calibration.rigid import inverse, motions, twists
from noise_model.compiled.arrays import Float64

MAX_ROUNDS, SETTLED_SIGMAS = 20, 1e-3
"""Rounds at most; one that moves nothing by more of its sigmas is the last."""


@dataclass(frozen=True)
class Boards:
    """Lens, warp and boards' poses, the corners, and 1 sigma of a corner in each image (V,), px."""

    scene: BoardScene
    seen: Sightings
    sigma_px: Float64

    @property
    def weight(self) -> Float64:
        """1 / sigma of each corner (N,), 1/px."""
        return np.asarray(1.0 / self.sigma_px[self.seen.view])

    def select_views(self, chosen: list[int]) -> Boards:
        """Return the boards of some of the images."""
        return Boards(self.scene.select_views(chosen), self.seen.select_views(chosen), self.sigma_px[chosen])


@dataclass(frozen=True)
class Refinement:
    """Result of a refinement: camera and board, warp and poses of maximum likelihood, and errors."""

    chain: Chain
    boards: Boards
    solution: VarianceSolution
    errors: PoseErrors

    @property
    def determined(self) -> float:
        """The number of unknowns that the poses determine: coefficients count by what their prior leaves."""
        priors = self.errors.prior(self.solution.sigma)
        return POSES + float(np.sum(1.0 - priors * np.diag(self.solution.covariance), where=priors > 0.0))

    @property
    def robot_error(self) -> Float64:
        """By what motion of the tool each pose was off most likely (V, 6), rad and mm."""
        return robot_errors(self.chain, self.boards.scene.T_camera_board)


def robot_errors(chain: Chain, T_camera_board: Float64) -> Float64:
    """Return by what motion of the tool each pose is off (V, 6), rad and mm, if boards are where stated."""
    eta = twists(T_camera_board @ inverse(chain.T_camera_board))
    return np.asarray(np.linalg.solve(chain.per_robot_error(), eta[:, :, np.newaxis])[:, :, 0])


def with_warp(scene: BoardScene, seen: Sightings) -> Boards:
    """Return boards fitted each by itself, with the warp that all share, and their corners' noise."""
    n, ones = len(scene.lens.values), np.ones(len(seen))
    # Far more rounds than a nearly linear problem takes.
    for _ in range(4):
        whole = linearise(scene, seen, ones)
        warp = slice(n, n + len(WARP))
        part = NormalEquations(
            whole.shared[:, warp, warp],
            whole.mixed[:, warp],
            whole.motion,
            whole.gradient_shared[:, warp],
            whole.gradient_motion,
        )
        step, motion = part.step()
        scene = scene.moved(np.concatenate([np.zeros(n), step]), motion)
    scene = adjust(scene, seen, ones, poses_only=True)
    return Boards(scene, seen, corner_sigmas_px(scene, seen, len(WARP) / len(seen.names)))


def pose_errors(
    chain: Chain, boards: Boards, lens_root: Float64
) -> tuple[PoseErrors, NormalEquations, Float64]:
    """Return the boards' prediction errors, the corners' normal equations, and eta (V, 6).

    `lens_root` (n, k) times its transpose is the lens' covariance.
    """
    equations = linearise(boards.scene, boards.seen, boards.weight)
    n = len(boards.scene.lens.values)
    covariance = np.linalg.inv(equations.motion)
    per_shared = covariance @ equations.mixed.transpose(0, 2, 1)
    eta = twists(boards.scene.T_camera_board @ inverse(chain.T_camera_board))
    unknowns = POSES + len(chain.coefficients)
    known = np.zeros((unknowns + len(WARP),) * 2)
    known[unknowns:, unknowns:] = equations.information()[n:, n:]
    pull = np.zeros(len(known))
    pull[unknowns:] = equations.view_gradients().sum(axis=0)[n:]
    errors = PoseErrors(
        error=eta + np.einsum("vij,vj->vi", covariance, equations.gradient_motion),
        by_corners=np.asarray(covariance),
        per_robot=chain.per_robot_error(),
        per_unknown=np.concatenate([chain.per_unknown(), per_shared[:, :, n:]], axis=2),
        known=known,
        pull=pull,
        per_lens=np.asarray(per_shared[:, :, :n]),
        lens_root=lens_root,
        first_coefficient=POSES,
        coefficients=chain.coefficients,
        blocks=tuple(block.shape[2] for block in chain.repeatable),
    )
    return errors, equations, eta


def refine(chain: Chain, boards: Boards, lens_root: Float64, sigma: Float64 | None = None) -> Refinement:
    """Return camera, board, warp, boards' poses and the robot's noise of maximum likelihood.

    `boards` are from `with_warp`; `lens_root` (n, k) is a root of the lens' covariance, (n, 0) for an exact
    lens. `sigma` (2 + b,) starts the search for the robot's, rad and mm, and the priors'. Raises
    numpy.linalg.LinAlgError if the poses do not determine camera and board.
    """
    for _ in range(MAX_ROUNDS):
        errors, equations, eta = pose_errors(chain, boards, lens_root)
        solution = solve(errors, robot_sigma(errors, sigma).sigma)
        sigma = solution.sigma
        chain, boards = _step(chain, boards, equations, eta, errors, solution)
        if (np.abs(solution.step) <= SETTLED_SIGMAS * np.sqrt(np.diag(solution.covariance))).all():
            break
    errors, _, _ = pose_errors(chain, boards, lens_root)
    return Refinement(chain, boards, solve(errors, solution.sigma), errors)


def _step(
    chain: Chain,
    boards: Boards,
    equations: NormalEquations,
    eta: Float64,
    errors: PoseErrors,
    solution: VarianceSolution,
) -> tuple[Chain, Boards]:
    step, warp = solution.step[: -len(WARP)], solution.step[-len(WARP) :]
    spread = errors.covariance(solution.sigma) - errors.by_corners
    W = np.linalg.inv(spread)
    mixed = equations.mixed[:, -len(WARP) :]
    pull = equations.gradient_motion - np.einsum("vmi,m->vi", mixed, warp)
    pull = pull + np.einsum("vij,vj->vi", W, errors.per_unknown[:, :, : -len(WARP)] @ step - eta)
    motion = np.linalg.solve(equations.motion + W, pull[:, :, np.newaxis])[:, :, 0]
    scene = boards.scene
    moved = motions(motion) @ scene.T_camera_board
    scene = replace(scene, T_camera_board=moved, warp_mm=scene.warp_mm + warp)
    return chain.moved(step), replace(boards, scene=scene)
