"""Selection of consistent poses: a wrong pair of image and pose is found by what the others predict.

The half of the poses that a start explains best (`best_half`) is refined. Then those that it predicts within
its noise are added, and so on until the set no longer changes. The better half makes the noise look smaller
than it is: the median distance of all poses corrects this.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f

from calibration.hand_eye_boards.chain import Chain
from calibration.hand_eye_boards.enough import MIN_POSES
from calibration.hand_eye_boards.refine import Boards, Refinement, pose_errors, refine
from calibration.outliers import FALSE_ALARM
from noise_model.compiled.arrays import Float64

MAX_ROUNDS = 12
MOTION = 6


@dataclass(frozen=True)
class PoseConsistency:
    """Consistent poses, and the errors of all.

    `kept` are at least `MIN_POSES`, `result` is theirs. `distance` (V,) is the mean square of each pose's
    error over its noise, `robot_error` (V, 6) the motion of the tool by which it is off, rad and mm, both by
    the kept ones.
    """

    kept: list[int]
    result: Refinement
    distance: Float64
    robot_error: Float64


def best_half(off_px: Float64) -> list[int]:
    """Return the half of the poses that a start explains best; `off_px` (V,) is each board's error."""
    return sorted(np.argsort(off_px)[: max(len(off_px) // 2 + 1, MIN_POSES)].tolist())


def select_consistent_poses(
    chain: Chain, boards: Boards, lens_root: Float64, kept: list[int]
) -> PoseConsistency:
    """Return the consistent poses, and their refinement, beginning with those `kept`.

    `lens_root` (n, k) is a root of the lens' covariance. Raises numpy.linalg.LinAlgError if the consistent
    poses do not determine camera and board.
    """
    count = len(chain.T_base_tool)
    sigma: Float64 | None = None
    for _ in range(MAX_ROUNDS):
        result = refine(chain.select_views(kept), boards.select_views(kept), lens_root, sigma)
        sigma = result.solution.sigma
        whole = replace(result.chain, T_base_tool=chain.T_base_tool, repeatable=chain.repeatable)
        agreement = _assess(kept, result, whole, boards, lens_root)
        freedom = max(round(MOTION * len(kept) - result.determined - len(sigma)), 2)
        limit = float(f.isf(FALSE_ALARM / count, MOTION, freedom))
        wider = max(float(np.median(agreement.distance) / f.median(MOTION, freedom)), 1.0)
        agree = np.flatnonzero(agreement.distance < wider * limit).tolist()
        if len(agree) < MIN_POSES or agree == kept:
            break
        kept = agree
    return agreement


def _assess(
    kept: list[int], result: Refinement, whole: Chain, boards: Boards, lens_root: Float64
) -> PoseConsistency:
    errors, _, _ = pose_errors(whole, boards, lens_root)
    V, H = errors.covariance(result.solution.sigma), errors.per_unknown
    spread = H @ result.solution.covariance @ H.transpose(0, 2, 1)
    # What was fitted to is nearer than its noise alone makes it.
    spread[kept] = 0.0
    # What the lens has wrong is no fault of a pose: the part of it that camera and board do not undo.
    by_lens = (errors.per_lens - H @ result.solution.per_lens) @ lens_root
    solved = np.linalg.solve(
        V + spread + by_lens @ by_lens.transpose(0, 2, 1), errors.error[:, :, np.newaxis]
    )[:, :, 0]
    distance = np.sum(errors.error * solved, axis=1) / MOTION
    robot_error = np.linalg.solve(errors.per_robot, errors.error[:, :, np.newaxis])[:, :, 0]
    return PoseConsistency(kept, result, np.asarray(distance), np.asarray(robot_error))
