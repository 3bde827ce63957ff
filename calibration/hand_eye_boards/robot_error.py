"""Repeatable errors of a robot's poses, and their choice by boards that are held out.

A pose is off by a small motion of the tool, xi = F b + noise, with R and t the pose in base, q its joints:

    joints    J(q) b                      b the offsets of all joints but the first and the last
    smooth    turn = B (R' z - z0)        B (3, 3), the tool's sag
              move = R' B (t - t0)        B (3, 3), a place that is off by a linear map
              R' g(R' z, t) + h(R' z, t)  g and h Gaussian processes, each of a turn and a move

z is base's third axis, mostly the plumb line: wrist and holder give way under their weight, as the tool leans
from z0, the upright tool. A linear map of the place is what link lengths make in first order, t0 their mean.
Joint offsets, bent links and gears make errors that go with base as a whole, and change slowly as the tool
leans and travels: g (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapter 2). What
goes with the tool as a whole no board tells from the camera's pose: h has a stated share of g's sigma. J is
the Jacobian of the kinematics (`kinematics`). The first joint's offset is a turn of base, the last one's a
turn of the tool: board and camera have them.

b is normal about 0 with sigmas that are estimated (`variances`). Each board is held out in turn: the others
give camera, board and b, with the sigmas of all, and predict its corners.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from calibration.camera.adjustment import BoardScene
from calibration.camera.sightings import Sightings
from calibration.hand_eye_boards.chain import Chain
from calibration.hand_eye_boards.refine import Boards, pose_errors
from calibration.hand_eye_boards.variances import PoseErrors, robot_sigma
from calibration.held_out import HeldOutScore
from noise_model.compiled.arrays import Float64

NONE, JOINTS, SMOOTH = "none", "joints", "smooth"

TURN_RAD, MOVE_MM, PLACE_SHARE, OFFSET_RAD = math.radians(0.1), 0.5, 1e-3, math.radians(0.05)
"""A common robot's coefficients: a turn and a move of the tool, the share of a way, a joint's offset."""

LEAN, TRAVEL_MM = 1.0, 500.0
"""Length scale of g and h: the plumb line's chord in the tool, and half an arm's reach.

Of half, once and twice of both, once has the largest likelihood on real boards.
"""

TOOL_SHARE = 0.2
"""Sigma of h over that of g: of less, 95 % intervals hold less (benchmarks/robot_errors.py)."""

MIN_MODE = 1e-3
"""Variance of a process' mode, relative to the largest, below which it is left out."""


@dataclass(frozen=True)
class RobotErrorScore(HeldOutScore):
    """Cross-validation of a model of the robot's repeatable error; losses are of corners, mm².

    `sigma` (2,) is the robot's noise under it, rad and mm.
    """

    sigma: Float64

    @property
    def rms_mm(self) -> float:
        """RMS distance of a held-out board's corners from their predicted places."""
        return math.sqrt(self.mean)


def repeatable_errors(T_base_tool: Float64, per_joint: Float64 | None) -> dict[str, tuple[Float64, ...]]:
    """Return the blocks (V, 6, k) of F of each model, each with a prior of its own, the leanest model first.

    `per_joint` (V, 6, k) are the tool's motions by joint offsets, rad and mm per rad; None if unknown.
    """
    models: dict[str, tuple[Float64, ...]] = {NONE: ()}
    if per_joint is not None:
        models[JOINTS] = (OFFSET_RAD * per_joint,)
    models[SMOOTH] = _smooth(T_base_tool)
    return models


def _smooth(T_base_tool: Float64) -> tuple[Float64, ...]:
    R, t = T_base_tool[:, :3, :3], T_base_tool[:, :3, 3]
    up, to_tool = R[:, 2, :], R.swapaxes(1, 2)
    mean = up.mean(axis=0)
    upright = np.zeros(3)
    axis = int(np.abs(mean).argmax())
    upright[axis] = np.sign(mean[axis])
    sag = _motions(TURN_RAD * _linear(up - upright), 0)
    place = _motions(PLACE_SHARE * to_tool @ _linear(t - t.mean(axis=0)), 1)
    where = np.hstack([up / LEAN, t / TRAVEL_MM])
    variance, modes = np.linalg.eigh(np.exp(-0.5 * cdist(where, where, "sqeuclidean")))
    kept = variance > MIN_MODE * variance[-1]
    along = np.einsum("vk,ab->vakb", modes[:, kept] * np.sqrt(variance[kept]), np.eye(3)).reshape(
        len(t), 3, -1
    )
    either = [
        _motions(size * share * frame @ along, part)
        for share, frame in ((1.0, to_tool), (TOOL_SHARE, np.eye(3)))
        for part, size in enumerate((TURN_RAD, MOVE_MM))
    ]
    return sag, place, np.concatenate(either, axis=2)


def _motions(columns: Float64, part: int) -> Float64:
    """Return the motions (V, 6, k) that are turns (V, 3, k), of part 0, or moves, of part 1."""
    nothing = np.zeros_like(columns)
    return np.concatenate([nothing, columns] if part else [columns, nothing], axis=1)


def _linear(vectors: Float64) -> Float64:
    """Return the derivatives (V, 3, 9) of B v by the rows of B, for vectors v (V, 3)."""
    return np.asarray(np.einsum("ab,vc->vabc", np.eye(3), vectors).reshape(-1, 3, 9))


def score_robot_errors(
    chain: Chain, boards: Boards, lens_root: Float64, models: Mapping[str, tuple[Float64, ...]]
) -> list[RobotErrorScore]:
    """Return the cross-validation of each model; `chain` and `boards` are refined, without any."""
    scores = []
    for name, blocks in models.items():
        errors, _, _ = pose_errors(chain.with_repeatable(blocks), boards, lens_root)
        best = robot_sigma(errors)
        loss = _held_out_mm2(errors, best.sigma, boards.scene, boards.seen)
        scores.append(RobotErrorScore(name, loss, best.log_likelihood, best.sigma[:2]))
    return scores


def _held_out_mm2(errors: PoseErrors, sigma: Float64, scene: BoardScene, seen: Sightings) -> Float64:
    """Return the mean square (V,) of the way from a board's corners to where the others put them, mm²."""
    by_lens = errors.per_lens @ errors.lens_root
    m, n = errors.per_unknown.shape[2], by_lens.shape[2]
    known = np.zeros((m + n, m + n))
    known[:m, :m], known[range(m, m + n), range(m, m + n)] = errors.information(sigma), 1.0
    rows = np.concatenate([errors.per_unknown, by_lens], axis=2)
    whole = errors.whole_error
    WR = np.linalg.solve(errors.covariance(sigma), rows)
    parts, pulls = rows.swapaxes(1, 2) @ WR, np.einsum("vim,vi->vm", WR, whole)
    information = parts.sum(axis=0) + known
    right = pulls.sum(axis=0) + np.pad(errors.pull, (0, n))
    losses = []
    points = scene.points_camera(seen)
    for v, part in enumerate(seen.slices):
        others = np.linalg.solve(information - parts[v], right - pulls[v])
        off = whole[v] - rows[v] @ others
        moves = off[3:] + np.cross(off[:3], points[part])
        losses.append(np.mean(np.sum(moves**2, axis=1)))
    return np.array(losses)
