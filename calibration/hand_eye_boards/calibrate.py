"""The camera's pose on a robot, from the robot's poses and corners of a board in images."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi, chi2, t

from calibration.camera.adjustment import BoardScene, adjust
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import check_corners
from calibration.camera.sightings import Sightings
from calibration.hand_eye_boards.chain import POSES, Chain
from calibration.hand_eye_boards.enough import (
    InconsistentError,
    PoseConsistency,
    best_half,
    check_count,
    check_sigmas,
    check_turns,
    select_consistent_poses,
    turns_deg,
)
from calibration.hand_eye_boards.kinematics import joint_motions
from calibration.hand_eye_boards.refine import Boards, Refinement, robot_errors, with_warp
from calibration.hand_eye_boards.robot_error import (
    NONE,
    OFFSET_RAD,
    RobotErrorScore,
    repeatable_errors,
    score_robot_errors,
)
from calibration.hand_eye_boards.start import first_chain, renumber
from calibration.held_out import choose_leanest
from calibration.threads import one_thread
from noise_model.compiled.arrays import Bool, Float64

MAX_OUTLIER_SHARE = 0.4
"""The share of poses that may contradict the rest: of more nobody knows which are right."""

MAX_ROBOT_DEG, MAX_ROBOT_MM = 1.0, 5.0
"""1 sigma of the robot's error that no robot has: the poses mean something else."""

MAX_SCALE_SIGMAS = 4.0
"""A board's scale that the robot's motions contradict by more is named."""

UNITS = np.array([math.degrees(1.0)] * 3 + [1.0] * 3)


@dataclass(frozen=True)
class HandEyeCalibration:
    """Calibrated camera pose and its uncertainty.

    `lens_covariance` (n, n) is of the lens' parameters as stated, zeros for an exact lens. `off_deg` and
    `off_mm` (V,) are the errors of each pose used against the common result. `robot_errors` are the models of
    the robot's repeatable error that were tried, `robot_error` is the one taken; `joints` are the joints
    whose offsets were tried, `no_joints` says why joint angles were of no use. `scale` is the board's size by
    the robot's motions over the stated one. `left_out` maps unused poses to the reason.
    """

    refined: Refinement
    lens_covariance: Float64
    off_deg: Float64
    off_mm: Float64
    robot_errors: list[RobotErrorScore]
    robot_error: RobotErrorScore
    joints: tuple[int, ...]
    no_joints: str | None
    scale: float
    scale_sigma: float
    left_out: dict[str, str]

    @property
    def T_holder_camera(self) -> Float64:
        """The camera's pose (4, 4), mm, in the tool, or eye to hand in the robot's base."""
        return self.refined.chain.T_holder_camera

    @property
    def is_eye_to_hand(self) -> bool:
        """True if the camera stands still and the robot carries the board."""
        return self.refined.chain.is_eye_to_hand

    @property
    def names(self) -> tuple[str, ...]:
        """The images that are used."""
        return self.refined.boards.seen.names

    @property
    def covariance(self) -> Float64:
        """The covariance (6, 6) of a small motion of the camera in its own frame, deg and mm."""
        return np.asarray(self.refined.solution.total[:6, :6] * np.outer(UNITS, UNITS))

    @property
    def sigma(self) -> Float64:
        """1 sigma (6,) of that motion, deg and mm."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def half_interval(self, share: float = 0.95) -> Float64:
        """Return half of each interval (6,) that holds the truth with a probability, deg and mm."""
        return np.asarray(t.isf(0.5 * (1.0 - share), self.refined.solution.freedom()[:6]) * self.sigma)

    @property
    def place_covariance(self) -> Float64:
        """The covariance (3, 3) of the camera's place, mm², along the holder's axes."""
        R = self.T_holder_camera[:3, :3]
        return np.asarray(R @ self.covariance[3:, 3:] @ R.T)

    @property
    def per_lens(self) -> Float64:
        """Derivatives of the camera's pose (6, n), deg and mm, in its own frame, by the lens' values."""
        # The solution goes with the lens' error, which falls as the stated value grows.
        return np.asarray(-UNITS[:, np.newaxis] * self.refined.solution.per_lens[:6])

    @property
    def own_covariance(self) -> Float64:
        """The covariance (6, 6) of that motion, deg and mm, were the lens exact."""
        return np.asarray(self.refined.solution.covariance[:6, :6] * np.outer(UNITS, UNITS))

    @property
    def by_robot(self) -> Float64:
        """The robot's part (6, 6) of that covariance: what is left of it is the corners' noise."""
        return np.asarray(self.refined.solution.by_robot[:6, :6] * np.outer(UNITS, UNITS))

    @property
    def robot_deg(self) -> float:
        """1 sigma of the robot's turn about each axis, deg."""
        return math.degrees(self.refined.solution.sigma[0])

    @property
    def robot_mm(self) -> float:
        """1 sigma of the robot's place along each axis, mm."""
        return float(self.refined.solution.sigma[1])

    @property
    def pose_sigma(self) -> tuple[float, float]:
        """1 sigma of a stated pose about each axis, deg and mm, repeatable errors and noise."""
        turn, move = self.robot_errors[0].sigma.tolist()
        return math.degrees(turn), move

    @property
    def robot_sigma(self) -> tuple[float, float]:
        """1 sigma of both, deg and mm, by the variances' own: d sigma = d sigma² / (2 sigma)."""
        spread = np.sqrt(np.diag(self.refined.solution.sigma_covariance)) / (
            2.0 * self.refined.solution.sigma[:2]
        )
        return math.degrees(spread[0]), float(spread[1])

    @property
    def corner_sigma_px(self) -> float:
        """1 sigma of a corner, RMS over the images."""
        return float(np.sqrt(np.mean(self.refined.boards.sigma_px**2)))

    @property
    def rms_px(self) -> float:
        """The RMS distance of corners from where the boards' poses put them, px."""
        boards = self.refined.boards
        return boards.scene.rms_px(boards.seen)

    @property
    def joint_offsets(self) -> tuple[Float64, Float64]:
        """The offsets (k,) by which true angles of `joints` exceed the stated ones, and 1 sigma, deg."""
        unit = math.degrees(OFFSET_RAD)
        offsets = self.refined.chain.coefficients
        variance = np.diag(self.refined.solution.total)[POSES : POSES + len(offsets)]
        return unit * offsets, unit * np.sqrt(variance)

    @property
    def turns_deg(self) -> Float64:
        """RMS rotations of the poses (3,) about the holder's axes, deg."""
        return np.asarray(np.sqrt(np.mean(turns_deg(self.refined.chain) ** 2, axis=0)))

    @property
    def is_scale_off(self) -> bool:
        """True if the robot's motions contradict the board's size."""
        return abs(self.scale - 1.0) > MAX_SCALE_SIGMAS * self.scale_sigma


def calibrate_hand_eye(
    scene: BoardScene,
    seen: Sightings,
    T_base_tool: Float64,
    *,
    is_eye_to_hand: bool = False,
    lens_covariance: Float64 | None = None,
    joint_rad: Float64 | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> HandEyeCalibration:
    """Calibrate the camera's pose in the tool, or eye to hand in base.

    `scene` has the lens, which is held, and the boards' poses from
    `calibration.camera.known_lens.board_poses`; `T_base_tool` (V, 4, 4) are the robot's, mm. Eye to hand, the
    camera stands still and the robot carries the board. Without `lens_covariance` (n, n) the lens counts as
    exact. `joint_rad` (V, n) are the robot's joint angles at the poses. `progress` is called with the steps
    done and their number. Raises UndeterminedError, which names the missing motion, if the poses do not
    determine the camera, InconsistentError if robot and boards contradict each other.
    """
    tell = progress or (lambda done, total: None)
    check_count(len(T_base_tool), 0)
    chain = Chain(T_base_tool, np.eye(4), np.eye(4), is_eye_to_hand)
    check_turns(chain)
    n = len(scene.lens.values)
    root = np.zeros((n, 0)) if lens_covariance is None else _root(lens_covariance)
    with one_thread():
        boards = with_warp(scene, seen)
        check_corners(boards.scene, boards.seen)
        tell(1, 4)
        chain, boards, off_px = _start(chain, boards)
        tell(2, 4)
        try:
            agreement = select_consistent_poses(chain, boards, root, best_half(off_px))
            models, joints, no_joints = _models(T_base_tool, joint_rad)
            scores = _scores(agreement, models, root)
            taken = choose_leanest(scores)
            if taken.name != NONE:
                chain = replace(agreement.result.chain, T_base_tool=T_base_tool)
                chain = chain.with_repeatable(models[taken.name])
                agreement = select_consistent_poses(chain, boards, root, agreement.kept)
        except np.linalg.LinAlgError:
            raise UndeterminedError(
                "the poses leave the camera open: add poses in which the robot turns 20 to 40 deg either way "
                "about two other axes"
            ) from None
        tell(3, 4)
        scale, scale_sigma = _scale(agreement.result)
        _check_agreement(agreement)
        _check_scale(scale, scale_sigma)
        check_sigmas(agreement.result.chain, agreement.result.solution.total[:6, :6])
    tell(4, 4)
    off = agreement.result.robot_error
    return HandEyeCalibration(
        refined=agreement.result,
        lens_covariance=root @ root.T,
        off_deg=np.degrees(np.linalg.norm(off[:, :3], axis=1)),
        off_mm=np.linalg.norm(off[:, 3:], axis=1),
        robot_errors=scores,
        robot_error=taken,
        joints=joints,
        no_joints=no_joints,
        scale=scale,
        scale_sigma=scale_sigma,
        left_out=_left_out(agreement, seen.names),
    )


def _models(
    T_base_tool: Float64, joint_rad: Float64 | None
) -> tuple[dict[str, tuple[Float64, ...]], tuple[int, ...], str | None]:
    """Return the models of a repeatable error, the joints with offsets, and why joint angles give none."""
    joints: tuple[int, ...] = ()
    per_joint, no_joints = None, None
    if joint_rad is not None:
        try:
            joints, per_joint = joint_motions(joint_rad, T_base_tool)
        except UndeterminedError as error:
            no_joints = str(error)
    return repeatable_errors(T_base_tool, per_joint), joints, no_joints


def _scores(
    agreement: PoseConsistency, models: Mapping[str, tuple[Float64, ...]], lens_root: Float64
) -> list[RobotErrorScore]:
    """Return how well each model predicts the boards of the consistent poses."""
    of_kept = {name: tuple(block[agreement.kept] for block in blocks) for name, blocks in models.items()}
    return score_robot_errors(agreement.result.chain, agreement.result.boards, lens_root, of_kept)


def _start(chain: Chain, boards: Boards) -> tuple[Chain, Boards, Float64]:
    """Return a starting chain, the boards turned to its ends, and the error of each, px."""
    scene, seen = boards.scene, boards.seen
    try:
        chain, T_camera_board, off_px = first_chain(
            chain.T_base_tool,
            scene.T_camera_board,
            seen.board,
            scene.lens,
            is_eye_to_hand=chain.is_eye_to_hand,
        )
    except np.linalg.LinAlgError as error:
        raise UndeterminedError(f"the camera's pose is open: {error}") from None
    _check_start(chain, T_camera_board)
    seen = renumber(seen, scene.T_camera_board, T_camera_board)
    own = replace(scene, T_camera_board=T_camera_board)
    # A distant board looks much the same when it is tilted the other way: the robot's poses decide.
    predicted = chain.T_camera_board
    in_front = (predicted[:, :3, :3] @ seen.board.points_mm.T)[:, 2] + predicted[:, 2, 3:4]
    is_seen = np.all(in_front > 0.0, axis=1)
    other = replace(scene, T_camera_board=_choose(is_seen, predicted, T_camera_board))
    other = adjust(other, seen, boards.weight, poses_only=True)
    squares = [np.sum(each.residuals(seen) ** 2, axis=1) * boards.weight**2 for each in (own, other)]
    excess = np.array([float((squares[1] - squares[0])[part].sum()) for part in seen.slices])
    # Of a thousand boards that fit as well as the best, one is refused.
    is_same = np.asarray(excess < chi2.isf(1e-3, 6))
    scene = replace(scene, T_camera_board=_choose(is_same, other.T_camera_board, T_camera_board))
    return chain, replace(boards, scene=scene, seen=seen), off_px


def _choose(is_first: Bool, first: Float64, second: Float64) -> Float64:
    return np.asarray(np.where(is_first[:, np.newaxis, np.newaxis], first, second))


def _root(covariance: Float64) -> Float64:
    """Return a root (n, n) of a covariance (n, n) that may be singular."""
    variance, directions = np.linalg.eigh(covariance)
    return np.asarray(directions * np.sqrt(np.maximum(variance, 0.0)))


def _check_agreement(agreement: PoseConsistency) -> None:
    """Raise InconsistentError if too many poses contradict the rest, or the noise is no robot's."""
    count, kept = len(agreement.distance), len(agreement.kept)
    sigma = agreement.result.solution.sigma
    deg, mm = math.degrees(sigma[0]), float(sigma[1])
    if count - kept > MAX_OUTLIER_SHARE * count:
        raise InconsistentError(f"only {kept} of {count} poses agree with what the camera sees")
    _check_robot(deg, mm)


def _check_start(chain: Chain, T_camera_board: Float64) -> None:
    """Raise InconsistentError if most poses are so far off the start that no refinement brings them near."""
    off = robot_errors(chain, T_camera_board)
    deg = math.degrees(float(np.median(np.linalg.norm(off[:, :3], axis=1))))
    mm = float(np.median(np.linalg.norm(off[:, 3:], axis=1)))
    # A start's robot error may be three times as large as any robot's.
    # The median length of three normal numbers.
    median = float(chi.median(3))
    _check_robot(deg / median, mm / median, 3.0)


def _check_robot(deg: float, mm: float, wider: float = 1.0) -> None:
    """Raise InconsistentError if the robot's error, 1 sigma, is `wider` times larger than any robot's."""
    if deg > wider * MAX_ROBOT_DEG or mm > wider * MAX_ROBOT_MM:
        raise InconsistentError(
            f"the robot's poses are {mm:.2g} mm and {deg:.2g} deg off what the camera sees (1 sigma, "
            f"{MAX_ROBOT_MM:g} mm and {MAX_ROBOT_DEG:g} deg are the most)"
        )


def _check_scale(scale: float, sigma: float) -> None:
    """Raise InconsistentError if the robot moves in another unit than the board."""
    # Beyond 1 % the board was measured wrong, or the robot's unit is another.
    if abs(scale - 1.0) > max(MAX_SCALE_SIGMAS * sigma, 0.01):
        raise InconsistentError(
            f"the robot's motions make the board {max(scale, 0.0):.3g} times as large as stated (1 sigma is "
            f"{sigma:.1g})"
        )


def _left_out(agreement: PoseConsistency, names: tuple[str, ...]) -> dict[str, str]:
    left_out = {}
    for n, name in enumerate(names):
        if n not in agreement.kept:
            error = agreement.robot_error[n]
            deg, mm = math.degrees(float(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))
            left_out[name] = (
                f"its pose is {mm:.2g} mm and {deg:.2g} deg off what the others say: it is another image's, "
                "or the board was moved"
            )
    return left_out


def _scale(result: Refinement) -> tuple[float, float]:
    """Return the board's size by the robot's motions over the stated one, and its 1 sigma.

    A board of 1 + q times the size stands as much farther away than it seems: e has a part -q t, with t the
    board's position in the camera. Lens and robot stay as they were estimated.
    """
    errors, solution = result.errors, result.solution
    column = np.zeros((len(errors.error), 6, 1))
    column[:, 3:, 0] = -result.boards.scene.T_camera_board[:, :3, 3]
    by_lens = errors.per_lens @ errors.lens_root
    rows = np.concatenate([errors.per_unknown, by_lens, column], axis=2)
    m, n = errors.per_unknown.shape[2], by_lens.shape[2]
    known = np.zeros((m + n + 1,) * 2)
    known[:m, :m], known[range(m, m + n), range(m, m + n)] = errors.information(solution.sigma), 1.0
    WR = np.linalg.solve(errors.covariance(solution.sigma), rows)
    information = np.einsum("vim,vin->mn", rows, WR) + known
    right = np.einsum("vim,vi->m", WR, errors.whole_error) + np.pad(errors.pull, (0, n + 1))
    unit = np.zeros(m + n + 1)
    unit[-1] = 1.0
    scale = 1.0 / np.sqrt(np.diag(information))
    of_size = scale * np.linalg.solve(information * np.outer(scale, scale), scale * unit)
    return 1.0 + float(of_size @ right), math.sqrt(float(of_size[-1]))
