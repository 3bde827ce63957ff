"""Which poses are consistent, and do they determine the camera's pose? If not, which motion is missing."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f

from calibration.camera.enough import UndeterminedError
from calibration.hand_eye_boards.chain import Chain
from calibration.hand_eye_boards.refine import Boards, Refinement, pose_errors, refine
from calibration.outliers import FALSE_ALARM
from calibration.rigid import inverse
from noise_model.compiled.arrays import Float64

MIN_POSES = 5
"""Poses: three determine the camera, two more say how large the robot's noise is."""

AXES = "xyz"
ADVICE = "20 to 40 deg either way"


class InconsistentError(UndeterminedError):
    """Robot and boards contradict each other: the poses mean something else than was stated."""


def turns_deg(chain: Chain) -> Float64:
    """Return the holder's rotation vectors (V, 3) from the mean pose, about its own axes, deg."""
    turns = Rotation.from_matrix(inverse(chain.T_holder_mount)[:, :3, :3])
    return np.asarray(np.degrees((turns.mean().inv() * turns).as_rotvec()))


def check_count(poses: int, left_out: int) -> None:
    """Raise UndeterminedError if there are too few poses."""
    if poses < MIN_POSES:
        others = f" ({left_out} left out)" if left_out else ""
        raise UndeterminedError(
            f"{poses} image{'s' if poses != 1 else ''} of the board with a pose of the robot{others}: "
            f"{MIN_POSES} at least are needed, and 15 are good; take more, the robot turned {ADVICE} about "
            "another axis in each"
        )


def check_turns(chain: Chain) -> None:
    """Raise UndeterminedError if the robot turns about no axis, or about one alone."""
    holder = holder_name(chain)
    turns = turns_deg(chain)
    _, size, axes = np.linalg.svd(turns / math.sqrt(len(turns)))
    # Below an RMS turn of 1 deg about an axis, the robot's errors of rotation pass for a motion.
    min_deg = 1.0
    if size[0] < min_deg:
        raise UndeterminedError(
            f"the robot does not turn between the images ({size[0]:.2g} deg RMS), and the camera's place is "
            f"unknown: add poses turned {ADVICE} about two axes of the {holder}, such as x and y"
        )
    if size[1] < min_deg:
        raise UndeterminedError(
            f"the robot turns about one axis alone, {axis_words(axes[0])} of the {holder}, and the camera's "
            f"place along it is unknown: add poses turned {ADVICE} about {_others(axes[0])} of the {holder}"
        )


def check_sigmas(chain: Chain, covariance: Float64) -> None:
    """Raise UndeterminedError if the camera's pose is badly known; `covariance` (6, 6) is in rad and mm."""
    R, holder = chain.T_holder_camera[:3, :3], holder_name(chain)
    turn, place = covariance[:3, :3], covariance[3:, 3:]
    for matrix, limit, scale, what, unit in (
        (place, 2.0, 1.0, "place along", "mm"),
        (turn, 0.5, math.degrees(1.0), "turn about", "deg"),
    ):
        variance, directions = np.linalg.eigh(matrix)
        sigma = scale * math.sqrt(max(float(variance[-1]), 0.0))
        if sigma > limit:
            worst = R @ directions[:, -1]
            sizes = np.sqrt(np.mean(turns_deg(chain) ** 2, axis=0))
            shown = ", ".join(f"{size:.0f}" for size in sizes)
            raise UndeterminedError(
                f"the camera's {what} {axis_words(worst)} of the {holder} is known to {sigma:.2g} {unit} "
                f"only (1 sigma, {limit:g} is the most); the robot turns by {shown} deg RMS about x, y, z: "
                f"add poses turned {ADVICE} about {_others(worst)} of the {holder}"
            )


def holder_name(chain: Chain) -> str:
    """Return the name of the camera's holder."""
    return "robot's base" if chain.is_eye_to_hand else "tool"


def axis_words(axis: Float64) -> str:
    """Return an axis in words: the coordinate axis that it nearly is, or its numbers."""
    n = int(np.abs(axis).argmax())
    if abs(axis[n]) > math.cos(math.radians(20.0)):
        return AXES[n]
    axis = axis * np.sign(axis[n])
    return f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"


def _others(axis: Float64) -> str:
    """Return the two coordinate axes that are most square to an axis, in words."""
    first, second = sorted(np.argsort(np.abs(axis))[:2])
    return f"{AXES[first]} and {AXES[second]}"


def turn_mismatch_deg(T_holder_mount: Float64, T_camera_board: Float64) -> float:
    """Return the median difference of robot and board rotations between two images, deg.

    Their rotation vectors differ by one rotation only, that of the camera in its holder (Park and Martin,
    Robot sensor calibration: solving AX = XB on the Euclidean group, 1994). It is fitted to all pairs, and
    then to the half that agrees best: a pose of another image spoils some of them. `T_holder_mount` (V, 4, 4)
    is as in `Chain`.
    """
    first, second = np.triu_indices(len(T_holder_mount), 1)
    robot, board = (
        (turns[first] * turns[second].inv()).as_rotvec(degrees=True)
        for turns in (Rotation.from_matrix(T[:, :3, :3]) for T in (T_holder_mount, T_camera_board))
    )
    agree = np.full(len(first), True)
    for _ in range(2):
        camera = Rotation.align_vectors(board[agree], robot[agree])[0]
        off = np.linalg.norm(board - camera.apply(robot), axis=1)
        agree = off <= np.median(off)
    return float(np.median(off))


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

    A wrong pair of image and pose is found by what the others predict. The half of the poses that a start
    explains best (`best_half`) is refined. Then those that it predicts within its noise are added, and so on
    until the set no longer changes. The better half makes the noise look smaller than it is: the median
    distance of all poses corrects this.

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
