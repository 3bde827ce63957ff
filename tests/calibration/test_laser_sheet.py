from dataclasses import replace

import numpy as np
import pytest
from camera_scenes import BOARD, SIZE, project
from laser_scenes import BOARDS, LEVEL, PINHOLE, PLANE, STAND, pictures, stripe_points, stripes, views
from scipy.spatial.transform import Rotation

from calibration.camera.enough import UndeterminedError
from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.laser.calibrate import LaserCalibration, calibrate_laser
from calibration.laser.image_line import lines_together
from calibration.laser.stripe import BoardStripe, LaserLight, board_area, find_stripe, laser_light
from noise_model.compiled.arrays import Float64

LENS = Lens(*SIZE, tuple(PINHOLE), np.array([*PINHOLE.values()]))
MIDDLE = np.array([0.0, 0.0, 175.0])


def found_sheet(
    boards: tuple = BOARDS,  # type: ignore[type-arg]
    seen: dict[str, BoardStripe] | None = None,
    corner_px: float = 0.05,
    lens: Lens = LENS,
    lens_covariance: Float64 | None = None,
) -> LaserCalibration:
    poses = board_poses(BOARD, views(boards, corner_px), lens)
    return calibrate_laser(*poses, stripes(boards) if seen is None else seen, STAND, lens_covariance)


def z_of(result: LaserCalibration) -> Float64:
    """Return the errors of two leans and of the place over their sigmas."""
    plane = result.plane * np.sign(result.plane[:3] @ PLANE[:3])
    rows = np.zeros((3, 4))
    rows[:2, :3], rows[2] = np.linalg.svd(PLANE[np.newaxis, :3])[2][1:], [*MIDDLE, 1.0]
    return np.asarray(rows @ (plane - PLANE) / np.sqrt(np.diag(rows @ result.covariance[:4, :4] @ rows.T)))


@pytest.mark.parametrize("wrong_share", [0.0, 0.15])
def test_the_sheet_is_within_its_sigmas(wrong_share: float) -> None:
    result = found_sheet(seen=stripes(wrong_share=wrong_share))
    assert np.abs(z_of(result)).max() < 3.5
    assert result.scatter == 1.0
    assert result.left_out == {}
    assert float(result.distance_sigma_mm(MIDDLE[np.newaxis])[0]) < 0.01


def test_without_noise_the_truth_comes_back() -> None:
    result = found_sheet(seen=stripes(sigma_px=0.0), corner_px=0.0)
    plane = result.plane * np.sign(result.plane[:3] @ PLANE[:3])
    assert plane == pytest.approx(PLANE, abs=1e-4)
    assert np.concatenate(result.points_mm)[:200] == pytest.approx(
        stripe_points(BOARDS[0])[np.argsort(stripe_points(BOARDS[0])[:, 1])], abs=1e-4
    )


def test_a_board_that_moved_between_its_images_is_named() -> None:
    seen = stripes()
    seen["3"] = replace(seen["3"], points_px=seen["3"].points_px + np.array([6.0, 0.0]))
    result = found_sheet(seen=seen)
    assert list(result.left_out) == ["3"]
    assert np.abs(z_of(result)).max() < 3.5


def test_a_bowed_sheet_comes_back_within_its_sigmas() -> None:
    off = []
    for seed in range(6):
        result = found_sheet(seen=stripes(seed=seed, bow=0.1))
        assert result.bow is not None
        assert result.bow.is_taken
        sign = np.sign(result.plane[:3] @ PLANE[:3])
        off.append((sign * result.fit.bow - 0.1) / np.sqrt(result.covariance[4, 4]))
        assert np.abs(z_of(result)).max() < 3.5
        flat_mm, bowed_mm = result.bow.held_out_mm
        assert bowed_mm < 0.7 * flat_mm
    print(f"bow: off by {np.round(off, 1)} sigmas")
    assert np.sqrt(np.mean(np.square(off))) < 1.6


def test_a_plane_is_given_no_bow() -> None:
    results = [found_sheet(seen=stripes(seed=seed)) for seed in range(6)]
    assert [result.fit.bow for result in results] == [0.0] * 6
    assert not any(result.covariance[4].any() for result in results)


def test_short_stripes_do_not_tell_a_bow() -> None:
    seen = {
        name: replace(stripe, points_px=stripe.points_px[95:125]) for name, stripe in stripes(bow=0.1).items()
    }
    result = found_sheet(seen=seen)
    assert result.bow is None or not result.bow.is_taken


@pytest.mark.parametrize("stripe_px", [0.01, 0.2])
@pytest.mark.parametrize("corner_px", [0.01, 0.1])
def test_boards_at_one_height_are_refused(stripe_px: float, corner_px: float) -> None:
    """Noise of the boards' depths must not pass for a spread of the stripes."""
    with pytest.raises(UndeterminedError, match=r"within .* mm of one line.*nearer to the camera"):
        found_sheet(LEVEL, stripes(LEVEL, stripe_px), corner_px)


def test_two_pairs_are_refused() -> None:
    with pytest.raises(UndeterminedError, match="2 pairs show board and stripe: 3 at least"):
        found_sheet(BOARDS[:2])


def test_a_camera_that_is_another_is_refused() -> None:
    bent = LENS.with_distortion(("k1",))
    with pytest.raises(UndeterminedError, match="calibrate the camera first"):
        found_sheet(lens=replace(bent, values=np.array([*LENS.values, 3.0])))


def test_an_uncertain_lens_makes_an_uncertain_sheet() -> None:
    """The sigma is by how much the sheet moves for a lens that is one sigma off."""
    variance = np.zeros((4, 4))
    variance[2, 2] = 0.5**2
    exact, result = found_sheet(), found_sheet(lens_covariance=variance)
    moved = found_sheet(lens=replace(LENS, values=LENS.values + np.array([0.0, 0.0, 0.5, 0.0])))
    shift = (moved.plane * np.sign(moved.plane[:3] @ exact.plane[:3]) - exact.plane) @ [*MIDDLE, 1.0]
    added = (
        result.distance_sigma_mm(MIDDLE[np.newaxis]) ** 2 - exact.distance_sigma_mm(MIDDLE[np.newaxis]) ** 2
    )
    assert added[0] == pytest.approx(shift**2, rel=0.1)


def test_the_plane_goes_to_the_tool_frame_with_its_covariance() -> None:
    result = found_sheet()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix(), [90.0, 5.0, 130.0]
    stated = np.array([*(T[:3, :3] @ result.plane[:3]), 0.0])
    plane, _, covariance = result.in_tool(T, stated)
    assert result.in_tool(T, -stated)[0].tolist() == (-plane).tolist()
    points = stripe_points(BOARDS[2])
    in_tool = points @ T[:3, :3].T + T[:3, 3]
    assert in_tool @ plane[:3] + plane[3] == pytest.approx(points @ result.plane[:3] + result.plane[3])
    row = np.column_stack([in_tool, np.ones(len(in_tool))])
    sigma = np.sqrt(np.einsum("ni,ij,nj->n", row, covariance[:4, :4], row))
    assert sigma == pytest.approx(result.distance_sigma_mm(points), rel=1e-6)


def test_alike_neighbours_count_as_fewer() -> None:
    white = np.random.default_rng(3).standard_normal(4000)
    alike = np.zeros(4000)
    for n in range(1, 4000):
        alike[n] = 0.6 * alike[n - 1] + white[n]
    assert lines_together(white) == pytest.approx(1.0, abs=0.2)
    # The sum of an autoregressive noise's correlations: (1 + a) / (1 - a).
    assert lines_together(alike) == pytest.approx(4.0, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
def test_a_stripe_is_found_in_pictures_whichever_way_it_runs(turned: bool) -> None:
    held = BOARDS[1]
    off, on = pictures(held, seed=4, flicker=1.08)
    scene, _ = board_poses(BOARD, views((held,)), LENS)
    area = board_area(BOARD, LENS, scene.T_camera_board[0])
    if turned:
        off, on, area = off.T, on.T, area.T
    stripe = find_stripe(laser_light(off, on, area))
    assert stripe is not None
    assert stripe.along_rows == turned
    points = stripe.points_px[:, ::-1] if turned else stripe.points_px
    truth = project(PINHOLE, stripe_points(held))
    course = np.polynomial.Polynomial.fit(truth[:, 1], truth[:, 0], 1)
    off_px = points[:, 0] - course(points[:, 1])
    assert len(points) > 150
    assert abs(np.median(off_px)) < 0.05
    assert np.sqrt(np.mean(off_px**2)) < 0.3


@pytest.mark.parametrize(("stripe_dn", "glint_x"), [(10.0, 0), (8.0, 220)])
def test_a_shorter_brighter_line_beside_it_is_not_the_stripe(stripe_dn: float, glint_x: int) -> None:
    # Dark squares hide half of the stripe: a glint's lines have more light in all.
    x, y = np.arange(320.0), np.arange(240.0)[:, np.newaxis]
    place, glint = 120.0 + 0.1 * (x - 160.0), 60.0 + 0.3 * (x - glint_x)
    is_glint = (x >= glint_x) & (x < glint_x + 90)
    light = stripe_dn * (0.3 + 0.7 * (x // 24 % 2)) * np.exp(-0.5 * ((y - place) / 2.0) ** 2)
    light += 40.0 * is_glint * np.exp(-0.5 * ((y - glint) / 1.5) ** 2)
    light += np.random.default_rng(glint_x).normal(0.0, 2.0, light.shape)
    noise, area = np.full(light.shape, 2.0, np.float32), np.ones(light.shape, dtype=bool)
    stripe = find_stripe(LaserLight(light.astype(np.float32), noise, area))
    assert stripe is not None
    off_px = stripe.points_px[:, 1] - np.interp(stripe.points_px[:, 0], x, place)
    assert np.abs(off_px).max() < 2.0


@pytest.mark.slow
def test_a_board_without_a_stripe_shows_none() -> None:
    held = BOARDS[0]
    scene, _ = board_poses(BOARD, views((held,)), LENS)
    area = board_area(BOARD, LENS, scene.T_camera_board[0])
    assert find_stripe(laser_light(*pictures(held, seed=5, with_laser=False), area)) is None
