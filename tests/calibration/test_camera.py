import itertools
from dataclasses import replace

import numpy as np
import pytest
from camera_scenes import BOARD, LENS, SIZE, VARIED, WARP_MM, Held, project, views

from calibration.boards.board import Board, BoardKind
from calibration.camera.adjustment import adjust, linearise
from calibration.camera.calibrate import CameraCalibration, calibrate_camera, fit_lens
from calibration.camera.enough import UndeterminedError
from calibration.camera.halves import MAX_RATIO
from calibration.camera.lens import ORDERS, Lens
from calibration.camera.next_board import mean_sigma
from calibration.camera.noise import shrink_variances
from calibration.camera.order import cross_validate
from calibration.camera.projection import Knowledge
from calibration.camera.sightings import BoardView, Sightings

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found() -> CameraCalibration:
    return calibrate_camera(BOARD, views(), SIZE, orders=["k1", "k1 k2"])


def truth(found: CameraCalibration) -> list[float]:
    return [*(LENS[name] for name in found.scene.lens.names), *WARP_MM]


@pytest.mark.slow
def test_lens_and_warp_are_within_their_sigmas(found: CameraCalibration) -> None:
    values = [*found.scene.lens.values, *found.scene.warp_mm]
    z = (np.array(values) - truth(found)) / found.sigma
    assert found.order == "k1 k2"
    assert np.abs(z).max() < 3.5
    assert found.noise.sigma_px == pytest.approx(0.1, rel=0.1)
    assert found.model_error is None


def test_without_noise_the_truth_comes_back() -> None:
    exact = fit_lens(BOARD, views(sigma_px=0.0), SIZE, orders=["k1 k2"])
    assert [*exact.scene.lens.values, *exact.scene.warp_mm] == pytest.approx(truth(exact), rel=1e-4)


def test_the_projection_is_that_of_the_documentation() -> None:
    lens = Lens(*SIZE, tuple(LENS), np.array([*LENS.values()]))
    points = np.random.default_rng(1).uniform(-50.0, 50.0, (20, 3)) + np.array([0.0, 0.0, 150.0])
    assert lens.project(points) == pytest.approx(project(LENS, points), abs=1e-9)
    rays = lens.rays(lens.project(points))
    assert rays == pytest.approx(points / points[:, 2:], abs=1e-9)


def test_normal_equations_are_those_of_finite_differences(found: CameraCalibration) -> None:
    seen, scene = found.seen, found.scene
    weight = np.full(len(seen), 10.0)
    equations = linearise(scene, seen, weight)
    n, step = len(scene.lens.values) + 2, 1e-6
    columns = []
    for k in range(n + 6 * len(seen.names)):
        change = np.zeros(n + 6 * len(seen.names))
        change[k] = step
        ends = [
            scene.moved(sign * change[:n], sign * change[n:].reshape(-1, 6)).residuals(seen)
            for sign in (1.0, -1.0)
        ]
        columns.append(10.0 * (ends[1] - ends[0]).ravel() / (2.0 * step))
    J = np.array(columns).T
    H = J.T @ J
    whole = np.linalg.inv(H[:n, :n] - H[:n, n:] @ np.linalg.solve(H[n:, n:], H[n:, :n]))
    scale = np.sqrt(np.diag(whole))
    correlation = equations.information() * np.outer(scale, scale)
    assert np.linalg.inv(correlation) == pytest.approx(whole / np.outer(scale, scale), abs=1e-3)
    # The step solves the whole of the equations.
    shared, motion = replace(
        equations,
        gradient_shared=np.ones((len(seen.names), n)),
        gradient_motion=np.ones((len(seen.names), 6)),
    ).step()
    right = np.concatenate([np.full(n, float(len(seen.names))), np.ones(6 * len(seen.names))])
    solved = np.concatenate([shared, motion.ravel()])
    assert np.abs(H @ solved - right).max() < 1e-3 * np.abs(H * solved).max()


@pytest.mark.slow
def test_sigma_of_the_projection_is_the_scatter_over_repeats() -> None:
    """Repeated calibrations see a point as far apart as stated, once the boards bring them together."""
    start = fit_lens(BOARD, views(sigma_px=0.0), SIZE, orders=["k1 k2"]).scene
    point = np.array([[-55.0, 40.0, 180.0]])
    errors, stated = [], []
    for seed in range(60):
        seen = Sightings.of(BOARD, views(seed=seed))
        weight = np.full(len(seen), 10.0)
        scene = adjust(start, seen, weight)
        motions = scene.T_camera_board @ np.linalg.inv(start.T_camera_board)
        D = linearise(scene, seen, weight).motion
        small = np.column_stack([motions[:, 2, 1], motions[:, 0, 2], motions[:, 1, 0], motions[:, :3, 3]])
        turn_move = np.linalg.solve(D.sum(axis=0), np.einsum("vij,vj->i", D, small))
        moved = point + np.cross(turn_move[:3], point) + turn_move[3:]
        errors.append(scene.lens.project(moved)[0] - start.lens.project(point)[0])
        known = Knowledge.of(linearise(scene, seen, weight))
        stated.append(known.projection_covariance(scene.lens, start.lens.project(point), 180.0)[0])
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(stated), errors)
    # The mean of 60 chi² of 2 degrees of freedom is 2 ± 0.26.
    assert np.mean(squares) == pytest.approx(2.0, abs=0.8)


def test_wrong_corners_are_named_and_do_no_harm(found: CameraCalibration) -> None:
    spoiled = views()
    spoiled[3].points_px[7] += [1.5, 0.0]
    spoiled[8].points_px[30] += [0.0, -40.0]
    result = fit_lens(BOARD, spoiled, SIZE, orders=["k1 k2"])
    assert [(wrong.view, wrong.corner) for wrong in result.wrong] == [(3, 7), (8, 30)]
    assert result.wrong[1].residual_px == pytest.approx([0.0, -40.0], abs=0.5)
    assert result.scene.lens.values == pytest.approx(found.scene.lens.values, abs=0.5)


def test_an_image_of_scattered_corners_is_left_out() -> None:
    spoiled = views()
    spoiled[4].points_px[::2] += np.random.default_rng(2).uniform(5.0, 9.0, spoiled[4].points_px[::2].shape)
    result = fit_lens(BOARD, spoiled, SIZE, orders=["k1 k2"])
    assert list(result.left_out) == ["4"]
    assert len(result.seen.names) == len(VARIED) - 1


def test_a_noisier_image_gets_a_larger_sigma() -> None:
    blurred = views()
    rng = np.random.default_rng(3)
    blurred[2] = replace(blurred[2], points_px=blurred[2].points_px + 0.5 * rng.standard_normal((42, 2)))
    sigma = fit_lens(BOARD, blurred, SIZE, orders=["k1 k2"]).noise.sigma_px
    assert sigma[2] > 3.0 * np.delete(sigma, 2).max()


def test_variances_lean_on_each_other_as_far_as_they_scatter() -> None:
    rng = np.random.default_rng(1)
    dof = np.full(400, 20.0)
    alike = rng.chisquare(20.0, 400) / 20.0
    shrunk, prior_dof = shrink_variances(alike, dof)
    assert prior_dof > 200.0
    assert shrunk.std() < 0.2 * alike.std()
    # Variances that are themselves scaled inverse chi² of 8 degrees of freedom.
    _, prior_dof = shrink_variances(alike * 8.0 / rng.chisquare(8.0, 400), dof)
    assert prior_dof == pytest.approx(8.0, rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("held", "why"),
    [
        (VARIED[:5], "5 images show the board: 6 at least"),
        (
            tuple(Held((0.3 + 0.1 * n, 0.5), 130.0 + 5.0 * n, about_z_deg=15.0 * n) for n in range(8)),
            "focal length is .* parallel to the sensor; .* leans 20 to 40 deg",
        ),
        (
            tuple(replace(each, place=(0.5, 0.5), depth_mm=600.0) for each in VARIED),
            "cover . % of the image.*nearer by.*upper left",
        ),
    ],
    ids=["few", "parallel", "in the middle"],
)
def test_images_that_do_not_determine_the_lens_are_refused(held: tuple[Held, ...], why: str) -> None:
    with pytest.raises(UndeterminedError, match=why):
        fit_lens(BOARD, views(held, sigma_px=0.05), SIZE, orders=["none"])


@pytest.mark.slow
def test_halves_contradict_each_other_where_the_model_is_wrong(found: CameraCalibration) -> None:
    assert found.ratio_of_halves < MAX_RATIO
    lean = calibrate_camera(BOARD, views(sigma_px=0.02), SIZE, orders=["none"])
    assert lean.model_error is not None
    assert "differ" in lean.model_error


def test_a_board_that_is_not_exact_is_taken_as_it_was_printed() -> None:
    """Corners that are off on the board are told from noise, and the lens is as good as its sigmas say."""
    offsets_mm = 0.02 * np.random.default_rng(4).standard_normal((42, 2))
    shown = views(sigma_px=0.03, print_mm=offsets_mm)
    result = fit_lens(BOARD, shown, SIZE, orders=["k1 k2"])
    assert result.print_sigma_mm == pytest.approx(0.02, rel=0.25)
    # The board's own place, turn and size are not those of the print.
    flat = BOARD.points_mm[:, :2] - BOARD.points_mm[:, :2].mean(axis=0)
    common = np.zeros((84, 4))
    common[0::2, 0] = common[1::2, 1] = 1.0
    common[:, 2], common[:, 3] = flat.ravel(), (flat @ [[0.0, 1.0], [-1.0, 0.0]]).ravel()
    truth, estimate = (
        places.ravel() - common @ np.linalg.lstsq(common, places.ravel(), rcond=None)[0]
        for places in (offsets_mm, result.scene.print_mm)
    )
    assert np.std(estimate - truth) < 0.3 * 0.02
    z = (result.scene.lens.values - [LENS[name] for name in result.scene.lens.names]) / result.sigma[:-2]
    assert np.abs(z).max() < 3.5
    assert result.noise.sigma_px == pytest.approx(0.03, rel=0.1)
    assert result.scatter == 1.0


def test_an_exact_board_stays_exact(found: CameraCalibration) -> None:
    assert found.print_sigma_mm == 0.0
    assert not found.scene.print_mm.any()


def test_the_next_board_helps_as_much_as_it_says(found: CameraCalibration) -> None:
    pose = found.next_board
    assert pose is not None
    assert pose.sigma_px < 0.95 * mean_sigma(found.known, found.scene, found.distance_mm)
    # An image of that very pose, taken, makes the sigma what was said.
    points = pose.points_px + 0.1 * np.random.default_rng(5).standard_normal(pose.points_px.shape)
    more = [*views(), BoardView("next", np.arange(len(points)), points)]
    after = fit_lens(BOARD, more, SIZE, orders=["k1 k2"])
    assert mean_sigma(after.known, after.scene, found.distance_mm) == pytest.approx(pose.sigma_px, rel=0.15)


def tilted_views(lens: Lens) -> list[BoardView]:
    """Return what a lens with a tilted sensor sees of the varied boards."""
    straight = fit_lens(BOARD, views(sigma_px=0.0, lens={**LENS, "k2": 0.0}), SIZE, orders=["k1"])
    seen = straight.seen
    points = lens.project(replace(straight.scene, lens=lens, warp_mm=WARP_MM).points_camera(seen))
    points += 0.02 * np.random.default_rng(1).standard_normal(points.shape)
    return [
        BoardView(name, seen.corner[part], points[part])
        for name, part in zip(seen.names, seen.slices, strict=True)
    ]


def test_a_tilted_sensor_is_found_by_the_lens_distortion() -> None:
    names = ("fx", "fy", "cx", "cy", "k1", "tau_x", "tau_y")
    lens = Lens(*SIZE, names, np.array([1000.0, 1003.0, 400.0, 300.0, -0.4, 0.12, -0.05]))
    result = fit_lens(BOARD, tilted_views(lens), SIZE, tilted=True, orders=["k1"])
    z = (result.scene.lens.values - lens.values) / result.sigma[: len(names)]
    assert np.abs(z).max() < 3.5


def test_a_tilt_that_nothing_tells_is_refused() -> None:
    names = ("fx", "fy", "cx", "cy", "tau_x", "tau_y")
    lens = Lens(*SIZE, names, np.array([1000.0, 1003.0, 400.0, 300.0, 0.12, -0.05]))
    with pytest.raises(UndeterminedError, match="the sensor's tilt is unknown"):
        fit_lens(BOARD, tilted_views(lens), SIZE, tilted=True, orders=["none"])


@pytest.mark.parametrize("text", ["chessboard:9x6:5mm", "charuco:8x6:5mm:3.7mm:5X5_100"])
def test_a_board_is_written_as_it_is_read(text: str) -> None:
    assert str(Board.parse(text)) == text


def test_a_charuco_board_counts_squares() -> None:
    board = Board.parse("charuco:8x6:5mm:3.7mm:DICT_5x5_100")
    assert (board.kind, board.columns, board.rows, board.dictionary) == (BoardKind.CHARUCO, 7, 5, "5X5_100")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("9x6:5mm", "is no board"),
        ("chessboard:9x6", "is no board"),
        ("chessboard:2x6:5mm", "2 x 6 inner corners"),
        ("chessboard:9x6:0mm", "must be > 0 mm"),
        ("charuco:8x6:5mm:6mm:5X5_100", "smaller than the squares"),
        ("charuco:8x6:5mm:3mm:7X7_1", "no dictionary DICT_7X7_1"),
    ],
)
def test_what_is_no_board_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Board.parse(text)


def test_every_distortion_holds_those_before_it() -> None:
    names = list(ORDERS.values())
    assert all(set(lean) < set(rich) for lean, rich in itertools.pairwise(names))


def test_held_out_errors_are_those_of_fits_without_the_board(found: CameraCalibration) -> None:
    seen, noise = found.seen, found.noise
    weight = noise.weight(seen)
    lens = found.scene.lens.with_distortion(ORDERS["k1 k2 p1 p2"])
    scene = adjust(replace(found.scene, lens=lens), seen, weight)
    held = cross_validate(scene, seen, noise, ["k1 k2 p1 p2"], tilted=False)[0]
    for n in (0, 4, 7):
        others = [view for view in range(len(seen.names)) if view != n]
        trained = adjust(
            scene.select_views(others), seen.select_views(others), 1.0 / np.repeat(noise.sigma_px[others], 42)
        )
        own = seen.select_views([n])
        start = replace(trained, T_camera_board=scene.T_camera_board[[n]])
        posed = adjust(start, own, np.full(42, 1.0 / noise.sigma_px[n]), poses_only=True)
        loss = np.sum(posed.residuals(own) ** 2) / noise.sigma_px[n] ** 2 / (2.0 * 42 - 6.0)
        assert held.loss[n] == pytest.approx(loss, rel=1e-3)


def test_terms_that_no_image_tells_stay_within_what_lenses_are() -> None:
    """Numerator and denominator of the rational distortion cannot cancel each other."""
    lens = fit_lens(BOARD, views(lens={**LENS, "k1": -0.05, "k2": 0.0}), SIZE, orders=["rational"]).scene.lens
    share = lens.values[4:] * np.sqrt(lens.prior_precision()[4:])
    assert np.abs(share).max() < 2.0
    assert lens.is_invertible


@pytest.mark.parametrize(
    ("names", "values", "is_invertible"),
    [
        (("k1",), (-0.35,), True),
        (("k1",), (-3.0,), False),
        (("k1", "k4"), (-0.5, -0.3), True),
        (("k1", "k4"), (-7.0, -6.9), False),
    ],
    ids=["barrel", "folded", "rational", "pole"],
)
def test_a_lens_that_folds_its_image_is_known(
    names: tuple[str, ...], values: tuple[float, ...], is_invertible: bool
) -> None:
    pinhole = Lens.simple(*SIZE, 1000.0)
    lens = replace(pinhole, names=(*pinhole.names, *names), values=np.array([*pinhole.values, *values]))
    assert lens.is_invertible is is_invertible


def test_what_a_lens_may_be_does_not_depend_on_the_images_size() -> None:
    full, half = (
        Lens.simple(width, height, focal).with_distortion(ORDERS["rational"]).prior_precision()
        for width, height, focal in ((640, 480, 2186.0), (320, 240, 1093.0))
    )
    assert half == pytest.approx(full)


def test_corners_that_are_too_noisy_are_blamed_where_boards_lean_enough() -> None:
    with pytest.raises(UndeterminedError, match=r"corners scatter by 2\.. px.* at the camera's own size"):
        fit_lens(BOARD, views(sigma_px=2.5), SIZE, orders=["none"])
