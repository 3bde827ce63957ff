"""Repeatable errors of a robot's poses, and their choice by boards that are held out.

A pose is off by a small motion of the tool, xi = F b + noise, with R and t the pose in base, q its joints:

    sag       turn = B (R' z - z0)       B (3, 3)
    place     move = R' B (t - t0)       B (3, 3)
    joints    J(q) b                     b the offsets of all joints but the first and the last

z is base's third axis, mostly the plumb line: wrist and holder give way under their weight, as the tool leans
from z0, the upright tool. A place that is wrong by a linear map is what link lengths make in first order, t0
their mean. J is the Jacobian of the kinematics (`kinematics`). The first joint's offset is a turn of base,
the last one's a turn of the tool: board and camera have them.

b is normal about 0 with a sigma that is estimated (`variances`). Each board is held out in turn: the others
give camera, board and b, with the sigmas of all, and predict its corners.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.adjustment import BoardScene
from calibration.camera.sightings import Sightings
from calibration.hand_eye_boards.chain import Chain
from calibration.hand_eye_boards.refine import Boards, pose_errors
from calibration.hand_eye_boards.variances import PoseErrors, robot_sigma
from calibration.held_out import HeldOutScore
from noise_model.compiled.arrays import Float64

NONE, JOINTS, SAG, PLACE = "none", "joints", "sag", "place"

SAG_RAD, PLACE_SHARE, OFFSET_RAD = math.radians(0.1), 1e-3, math.radians(0.05)
"""A common robot's coefficients: the turn of a tool on its side, the share of a way, a joint's offset."""


@dataclass(frozen=True)
class RobotErrorScore(HeldOutScore):
    """Cross-validation of a model of the robot's repeatable error; losses are of corners, mm².

    `sigma` (2,) is the robot's noise under it, rad and mm; `per_coefficient` (V, 6, k) is F.
    """

    sigma: Float64
    per_coefficient: Float64

    @property
    def rms_mm(self) -> float:
        """RMS distance of a held-out board's corners from their predicted places."""
        return math.sqrt(self.mean)


def repeatable_errors(T_base_tool: Float64, per_joint: Float64 | None) -> dict[str, Float64]:
    """Return F (V, 6, k) of each model, the leanest first.

    `per_joint` (V, 6, k) are the tool's motions by joint offsets, rad and mm per rad; None if unknown.
    """
    R, t = T_base_tool[:, :3, :3], T_base_tool[:, :3, 3]
    up = R[:, 2, :]
    mean = up.mean(axis=0)
    upright = np.zeros(3)
    axis = int(np.abs(mean).argmax())
    upright[axis] = np.sign(mean[axis])
    nothing = np.zeros((len(R), 3, 9))
    models = {NONE: np.zeros((len(R), 6, 0))}
    if per_joint is not None:
        models[JOINTS] = OFFSET_RAD * per_joint
    models[SAG] = np.concatenate([SAG_RAD * _linear(up - upright), nothing], axis=1)
    move = R.swapaxes(1, 2) @ _linear(t - t.mean(axis=0))
    models[PLACE] = np.concatenate([nothing, PLACE_SHARE * move], axis=1)
    return models


def _linear(vectors: Float64) -> Float64:
    """Return the derivatives (V, 3, 9) of B v by the rows of B, for vectors v (V, 3)."""
    return np.asarray(np.einsum("ab,vc->vabc", np.eye(3), vectors).reshape(-1, 3, 9))


def score_robot_errors(
    chain: Chain, boards: Boards, lens_root: Float64, models: Mapping[str, Float64]
) -> list[RobotErrorScore]:
    """Return the cross-validation of each model; `chain` and `boards` are refined, without any."""
    scores = []
    for name, per_coefficient in models.items():
        tried = replace(
            chain, per_coefficient=per_coefficient, coefficients=np.zeros(per_coefficient.shape[2])
        )
        errors, _, _ = pose_errors(tried, boards, lens_root)
        best = robot_sigma(errors)
        loss = _held_out_mm2(errors, best.sigma, boards.scene, boards.seen)
        scores.append(RobotErrorScore(name, loss, best.log_likelihood, best.sigma[:2], per_coefficient))
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
