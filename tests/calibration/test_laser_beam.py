import numpy as np
import pytest
from camera_scenes import BOARD, SIZE, Held, project
from laser_scenes import BOARDS, PINHOLE, PLANE, SHEET_SIGMA_MM, flat_pose, pictures, stripe_points, views

from calibration.camera.known_lens import board_poses
from calibration.camera.lens import Lens
from calibration.laser.cross_sections import CrossSections, cross_sections, placed
from calibration.laser.fan import Fan, Missing, ends_of, fit_fan
from calibration.laser.lit_board import LitBoard, lit_board
from calibration.laser.stripe import BoardStripe, board_area, find_stripe, laser_light
from calibration.laser.width import Law, Width, fit_width
from noise_model.compiled.arrays import Float64, UInt8

LENS = Lens(*SIZE, tuple(PINHOLE), np.array([*PINHOLE.values()]))
HELD = BOARDS[1]


@pytest.fixture(scope="module")
def shown() -> tuple[UInt8, UInt8, Float64]:
    """Return a pair's pictures and the board's pose."""
    scene, _ = board_poses(BOARD, views((HELD,)), LENS)
    return (*pictures(HELD, seed=4), scene.T_camera_board[0])


@pytest.fixture(scope="module")
def lit(shown: tuple[UInt8, UInt8, Float64]) -> LitBoard:
    return lit_board(shown[1], BOARD, LENS, shown[2], 0.7)


def off_course_px(stripe: BoardStripe, held: Held = HELD) -> Float64:
    """Return how far a stripe's points are from where they are drawn."""
    truth = project(PINHOLE, stripe_points(held))
    course = np.polynomial.Polynomial.fit(truth[:, 1], truth[:, 0], 1)
    return np.asarray(stripe.points_px[:, 0] - course(stripe.points_px[:, 1]))


@pytest.mark.slow
def test_the_stripes_width_is_the_sheets_as_the_camera_sees_it(shown: tuple[UInt8, UInt8, Float64]) -> None:
    off, on, T = shown
    light = laser_light(off, on, board_area(BOARD, LENS, T))
    stripe = find_stripe(light)
    assert stripe is not None
    sections = cross_sections(light, off, on, stripe)
    assert sections is not None
    turn, move = flat_pose(HELD)
    m = turn.apply([0.0, 0.0, 1.0])
    ends = [sections.points_px(aside_px=aside) for aside in (-0.5, 0.5)]
    rays = [np.column_stack([(p - [410.0, 290.0]) / [1000.0, 1003.0], np.ones(len(p))]) for p in ends]
    off_mm = [(r * (m @ move / (r @ m))[:, np.newaxis]) @ PLANE[:3] for r in rays]
    width_mm = np.abs(off_mm[1] - off_mm[0]) * sections.width_px
    # The drawn stripe is not blurred.
    assert np.nanmedian(width_mm) == pytest.approx(SHEET_SIGMA_MM, rel=0.02)


@pytest.mark.slow
def test_a_squares_edge_draws_the_stripe_to_its_light_side_but_not_its_cross_sections() -> None:
    held = BOARDS[0]
    scene, _ = board_poses(BOARD, views((held,)), LENS)
    off, on = pictures(held, seed=4)
    light = laser_light(off, on, board_area(BOARD, LENS, scene.T_camera_board[0]))
    stripe = find_stripe(light)
    assert stripe is not None
    sections = cross_sections(light, off, on, stripe)
    assert sections is not None
    by_centroid, by_sections = (off_course_px(each, held) for each in (stripe, placed(stripe, sections)))
    assert np.std(by_centroid) > 0.5
    assert np.std(by_sections) < 0.2


@pytest.mark.slow
def test_a_stripe_is_found_on_a_lit_board_in_one_image(lit: LitBoard) -> None:
    stripe = find_stripe(lit.light)
    assert stripe is not None
    assert len(stripe.points_px) > 150
    assert abs(np.median(off_course_px(stripe))) < 0.05
    assert np.sqrt(np.mean(off_course_px(stripe) ** 2)) < 0.3
    assert lit.rest_dn < 0.03 * lit.contrast_dn


def test_a_lit_board_without_a_stripe_shows_none(shown: tuple[UInt8, UInt8, Float64]) -> None:
    assert find_stripe(lit_board(shown[0], BOARD, LENS, shown[2], 0.7).light) is None


def drawn_sections(first: int, last: int, dark: tuple[int, int] | None = None) -> CrossSections:
    """Return the sections of a stripe that is lit from one scan line to another."""
    scan = np.arange(200)
    rng = np.random.default_rng(1)
    is_lit = (scan >= first) & (scan < last)
    amount = is_lit * (5.0 + rng.normal(0.0, 1.0, 200)) + rng.normal(0.0, 0.1, 200)
    sigma = np.full(200, 0.1)
    if dark is not None:
        sigma[slice(*dark)] = np.inf
    return CrossSections(
        scan, np.full(200, 50.0), False, np.zeros(200), np.where(is_lit, 3.0, np.nan), amount, sigma
    )


@pytest.mark.parametrize(
    ("sections", "ends"),
    [
        (drawn_sections(40, 150), (39.5, 149.5)),
        (drawn_sections(0, 150), (Missing.BOARD, 149.5)),
        (drawn_sections(40, 150, (140, 170)), (39.5, Missing.SQUARE)),
        (drawn_sections(40, 150, (145, 200)), (39.5, Missing.SQUARE)),
    ],
)
def test_an_end_is_seen_or_why_not(sections: CrossSections, ends: tuple[float, float]) -> None:
    for seen, true in zip(ends_of(sections), ends, strict=True):
        assert seen == true if isinstance(true, Missing) else abs(float(seen) - true) <= 1.0


def drawn_sides(depths: Float64, noise_mm: float) -> list[Float64]:
    """Return ends of a fan from (-3, 2) mm, 6 deg to either side and turned by 1 deg."""
    rng = np.random.default_rng(3)
    slopes = np.tan(np.radians([-5.0, 7.0]))
    return [
        np.column_stack([depths, 2.0 + k * (depths + 3.0) + noise_mm * rng.standard_normal(len(depths))])
        for k in slopes
    ]


def test_the_fan_comes_from_where_its_sides_meet() -> None:
    sides = drawn_sides(np.linspace(100.0, 140.0, 12), 0.05)
    sides[0][4, 1] += 5.0
    fan = fit_fan(sides, 0.05)
    assert isinstance(fan, Fan)
    error = np.array([*fan.apex, fan.half_angle_deg, fan.turn_deg]) - [-3.0, 2.0, 6.0, 1.0]
    assert np.abs(error / fan.sigma).max() < 3.5
    assert fan.sigma[2] < 0.2


@pytest.mark.parametrize(
    ("sides", "missing"),
    [
        (drawn_sides(np.linspace(119.0, 121.0, 12), 0.5), "at too equal depths"),
        ([side[:2] for side in drawn_sides(np.linspace(100.0, 140.0, 12), 0.05)], "2 and 2 ends"),
    ],
)
def test_a_fan_that_the_ends_do_not_tell_is_none(sides: list[Float64], missing: str) -> None:
    fan = fit_fan(sides, 0.05)
    assert isinstance(fan, str)
    assert missing in fan


def fitted_width(sigma_mm: Float64, depths: Float64, error_mm: float = 1e-3) -> Width:
    noisy = sigma_mm + error_mm * np.random.default_rng(2).standard_normal(len(depths))
    width = fit_width({float(z): (float(s), error_mm) for z, s in zip(depths, noisy, strict=True)}, 120.0)
    assert width is not None
    return width


def test_a_beams_waist_is_told_from_the_models_sheet() -> None:
    depths = np.linspace(90.0, 140.0, 10)
    beam = fitted_width(0.1 * np.sqrt(1.0 + ((depths - 110.0) / 20.0) ** 2), depths)
    assert beam.law is Law.WAIST
    assert beam.waist is not None
    for (value, sigma), true in zip(
        (beam.waist.depth_mm, beam.waist.sigma_mm, beam.waist.rayleigh_mm), (110.0, 0.1, 20.0), strict=True
    ):
        assert abs(value - true) < 3.5 * sigma < 0.3 * true
    plain = fitted_width(0.3 * depths / 120.0, depths)
    assert plain.law is Law.MODEL
    assert plain.at_height_mm is not None
    assert abs(plain.at_height_mm[0] - 0.3) < 3.5 * plain.at_height_mm[1]


def test_a_width_far_from_tool_height_is_not_followed_there() -> None:
    depths = np.linspace(60.0, 80.0, 8)
    far = fitted_width(0.02 * (depths - 50.0), depths)
    assert far.law is Law.STRAIGHT
    assert far.at_height_mm is None
