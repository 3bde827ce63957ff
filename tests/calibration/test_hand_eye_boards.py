from dataclasses import replace

import numpy as np
import pytest
from camera_scenes import BOARD
from hand_eye_scenes import HELD, ROBOT_DEG, ROBOT_MM, TRUE_LENS, Shown, board_in_camera, off, rigid, shown
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board, BoardKind
from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.camera.sightings import BoardView
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from calibration.hand_eye_boards.enough import InconsistentError
from calibration.hand_eye_boards.variances import PoseErrors, robot_sigma, solve
from noise_model.compiled.arrays import Float64


def found_camera(
    seen: Shown,
    *,
    is_eye_to_hand: bool = False,
    board: Board = BOARD,
    lens: Lens = TRUE_LENS,
    lens_covariance: Float64 | None = None,
) -> HandEyeCalibration:
    return calibrate_hand_eye(
        *board_poses(board, seen.views, lens),
        seen.T_base_tool,
        is_eye_to_hand=is_eye_to_hand,
        lens_covariance=lens_covariance,
    )


@pytest.mark.parametrize("is_eye_to_hand", [False, True])
def test_the_camera_is_within_its_sigmas(is_eye_to_hand: bool) -> None:
    result = found_camera(shown(is_eye_to_hand=is_eye_to_hand), is_eye_to_hand=is_eye_to_hand)
    assert np.abs(off(result.T_holder_camera) / result.sigma).max() < 3.5
    assert result.sigma[3:].max() < 0.1
    assert (result.half_interval() > 1.96 * result.sigma).all()
    for size, sigma, true in zip(
        (result.robot_deg, result.robot_mm), result.robot_sigma, (ROBOT_DEG, ROBOT_MM), strict=True
    ):
        assert abs(size - true) < 3.0 * sigma
    assert abs(result.scale - 1.0) < 3.5 * result.scale_sigma
    assert result.left_out == {}


def test_without_noise_the_truth_comes_back() -> None:
    result = found_camera(shown(noise=1e-4))
    assert np.abs(off(result.T_holder_camera)).max() < 1e-3
    assert result.robot_mm < 1e-3


def test_a_pose_of_another_image_is_named() -> None:
    seen = shown()
    poses = seen.T_base_tool.copy()
    poses[[3, 6]] = poses[[6, 3]]
    result = found_camera(replace(seen, T_base_tool=poses))
    assert sorted(result.left_out) == ["3", "6"]
    assert "it is another image's" in result.left_out["3"]
    assert np.abs(off(result.T_holder_camera) / result.sigma).max() < 3.5


def test_a_board_whose_ends_are_alike_is_turned_to_fit() -> None:
    board = Board(BoardKind.CHESSBOARD, 7, 5, 10.0)
    seen = shown(board=board)
    views = [
        BoardView(view.name, view.corners, view.points_px[:: -1 if n in (2, 5) else 1])
        for n, view in enumerate(seen.views)
    ]
    result = found_camera(replace(seen, views=views), board=board)
    assert result.left_out == {}
    assert np.abs(off(result.T_holder_camera) / result.sigma).max() < 3.5


@pytest.mark.parametrize(
    ("turns_deg", "line"),
    [
        ([(0, 0, 0)] * 6, r"does not turn .* about two axes of the tool"),
        ([(0, 0, spin) for spin in (0, 40, 80, -40, -80, 20)], r"one axis alone, \(.*\) of the tool.*about"),
        ([(5, 0, 0), (-4, 4, 0)] * 2, r"4 images of the board .*: 5 at least are needed"),
        (
            [(1.5, 0, 9), (-1.5, 0, -8), (0, 0, 40), (1, 0.3, -30), (0, 1, 3)],
            r"is known to .* only .* the robot turns by .*: add",
        ),
    ],
    ids=["none", "one axis", "too few", "hardly another"],
)
def test_motions_that_leave_the_camera_open_are_refused(
    turns_deg: list[tuple[float, ...]], line: str
) -> None:
    boards = []
    for n, turn in enumerate(turns_deg):
        T = board_in_camera(HELD[0])
        # The board turns about its middle, and moves a little.
        middle = T @ np.array([30.0, 25.0, 0.0, 1.0])
        R = Rotation.from_euler("XYZ", turn, degrees=True)
        T = rigid(R, middle[:3] + np.array([n % 3, n % 2, 2.0 * n]) - R.apply([30.0, 25.0, 0.0]))
        boards.append(T)
    with pytest.raises(UndeterminedError, match=line):
        found_camera(shown(boards))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ("transposed", "off what the camera sees|poses agree"),
        ("in m", "off what the camera sees|times as large as stated"),
    ],
)
def test_poses_that_mean_something_else_are_refused(change: str, line: str) -> None:
    seen = shown()
    poses = seen.T_base_tool.copy()
    if change == "transposed":
        poses[:, :3, :3] = poses[:, :3, :3].swapaxes(1, 2)
    else:
        poses[:, :3, 3] /= 1000.0
    with pytest.raises(InconsistentError, match=line):
        found_camera(replace(seen, T_base_tool=poses))


def test_an_uncertain_lens_makes_an_uncertain_camera() -> None:
    """The sigma is by how much the camera moves for a lens that is one sigma off."""
    seen, step = shown(), np.zeros(len(TRUE_LENS.values))
    step[2] = 0.3
    covariance = np.outer(step, step)
    exact, result = found_camera(seen), found_camera(seen, lens_covariance=covariance)
    other = found_camera(seen, lens=replace(TRUE_LENS, values=TRUE_LENS.values + step))
    shift = off(exact.T_holder_camera) - off(other.T_holder_camera)
    added = np.diag(result.covariance - exact.covariance)
    assert np.sqrt(added[[1, 3]]) == pytest.approx(np.abs(shift[[1, 3]]), rel=0.15)
    # What is off is the way from the camera found to the true one.
    assert -result.per_lens[:, 2] * 0.3 == pytest.approx(-shift, abs=0.1 * np.abs(shift).max())


def test_the_covariance_is_that_of_dense_matrices() -> None:
    """The sums over images are those of Patterson and Thompson's, and Kenward and Roger's, whole matrices."""
    rng = np.random.default_rng(4)
    count, m = 7, 4
    roots = rng.normal(size=(count, 6, 6))
    errors = PoseErrors(
        rng.normal(size=(count, 6)),
        roots @ roots.swapaxes(1, 2),
        rng.normal(size=(count, 6, 6)),
        rng.normal(size=(count, 6, m)),
        np.zeros((m, m)),
        np.zeros(m),
        np.zeros((count, 6, 1)),
        np.zeros((1, 0)),
    )
    sigma = np.array([0.7, 1.3])
    solution = solve(errors, sigma)

    def whole(blocks: Float64) -> Float64:
        matrix = np.zeros((6 * count, 6 * count))
        for n, block in enumerate(blocks):
            matrix[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = block
        return matrix

    H = errors.per_unknown.reshape(-1, m)
    W = np.linalg.inv(whole(errors.covariance(sigma)))
    parts = [whole(part) for part in errors.parts().swapaxes(0, 1)]
    C = np.linalg.inv(H.T @ W @ H)
    P = W - W @ H @ C @ H.T @ W
    information = 0.5 * np.array([[np.trace(P @ a @ P @ b) for b in parts] for a in parts])
    assert solution.sigma_covariance == pytest.approx(np.linalg.inv(information), rel=1e-8)
    assert solution.step == pytest.approx(C @ H.T @ W @ errors.error.ravel(), rel=1e-8)
    w = solution.sigma_covariance
    spread = sum(
        w[k, n] * H.T @ W @ a @ P @ b @ W @ H for k, a in enumerate(parts) for n, b in enumerate(parts)
    )
    assert solution.covariance == pytest.approx(C + 2.0 * C @ spread @ C, rel=1e-8)
    by_corners = C @ H.T @ W @ whole(errors.by_corners) @ W @ H @ C
    assert solution.by_robot == pytest.approx(solution.covariance - by_corners, rel=1e-8)

    def cost(sigma: Float64) -> float:
        V = whole(errors.covariance(sigma))
        W = np.linalg.inv(V)
        S = H.T @ W @ H
        e = errors.error.ravel()
        left = e - H @ np.linalg.solve(S, H.T @ W @ e)
        likelihood = np.linalg.slogdet(V)[1] + np.linalg.slogdet(S)[1] + left @ W @ left
        return float(likelihood - 2.0 * np.log(sigma).sum())

    best = robot_sigma(errors).sigma
    steps = (np.array(factor) for factor in ((1.05, 1.0), (1.0, 1.05), (0.95, 1.0), (1.0, 0.95)))
    assert all(cost(best) <= cost(best * step) + 1e-6 for step in steps)


def test_a_lens_that_is_off_within_its_covariance_leaves_no_pose_out() -> None:
    variances = np.full(len(TRUE_LENS.values), 1e-12)
    variances[:4] = 4.0, 4.0, 9.0, 9.0
    values = TRUE_LENS.values.copy()
    values[:4] += [2.0, 2.0, -3.0, 3.0]
    wrong = replace(TRUE_LENS, values=values)
    seen = shown(noise=0.2)
    assert found_camera(seen, lens=wrong, lens_covariance=np.diag(variances)).left_out == {}
