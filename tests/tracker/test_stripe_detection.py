"""What tells a stripe from the arc's map's own misses, and a stripe that leaves the image."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import CURRENT_A, EXPOSURE_S, SEED, frame_of, pose_at, small_setup

from noise_model.compiled.arrays import Bool, Float64
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import SeamLine
from tracker.state import Frame
from tracker.stripe.detection import (
    ABSENT_COST,
    CHANCE_SIGMAS,
    CLEAR_SIGMAS,
    LOBE,
    LOBE_MARGIN,
    MIN_FAN_SHARE,
    MIN_RATIO,
    WEAK,
    evidence_ratio,
    fan_ends,
    leaves_image,
    own_lobes,
    path_of,
    seen_share,
)
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.viterbi import GAIN_CAP, OFFSET_STEP, matched_filter
from tracker.tracker import Tracker

N_SCAN, N, MIDDLE = 200, 60, 30
EVERYWHERE = np.ones(N_SCAN, dtype=np.bool_)
ONE_FACE = np.zeros(N_SCAN, np.int64)
JOINTS = ("v_groove", "lap", "corrugation", "butt", "fillet", "half_v", "u_groove", "edge")


def ratio_plainly(score: np.ndarray, at: np.ndarray, shown: np.ndarray, width_px: float) -> float:
    worst, reach_px = own_lobes(width_px)
    found = np.where(at >= 0, np.maximum(np.take_along_axis(score, at[:, None], 1)[:, 0], 0.0), 0.0)
    beside = np.where(at >= 0, np.take_along_axis(score, at[:, None], 1)[:, 0], found[at >= 0].mean())
    away_px = np.abs(np.arange(score.shape[1]) - at[:, None]) * OFFSET_STEP
    is_near = (at[:, None] < 0) | (away_px <= reach_px)
    limit = np.where(is_near, max(LOBE, LOBE_MARGIN * worst), LOBE) * beside[:, None]
    dark = np.where(-score > limit, -score, 0.0).max(axis=1)
    dark = dark[(dark > CHANCE_SIGMAS) & (shown | (at >= 0))]
    against = np.minimum(dark**2 / 2, GAIN_CAP).sum()
    return float(np.minimum(found**2 / 2, GAIN_CAP).sum() / against) if against else np.inf


def test_the_ratio_is_its_plain_twins() -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(20):
        score = rng.normal(0.0, rng.uniform(0.5, 8.0), (N_SCAN, N)).astype(np.float32)
        at = rng.integers(-1, N, N_SCAN)
        shown = rng.random(N_SCAN) < 0.7
        width_px = rng.uniform(0.7, 4.0)
        plainly = ratio_plainly(score, at, shown, width_px)
        assert evidence_ratio(score, at, shown, width_px) == pytest.approx(plainly, rel=1e-5)


def test_noise_is_no_evidence_and_either_sign_alike_is_a_tie() -> None:
    rng = np.random.default_rng(SEED)
    score = rng.normal(0.0, 1.0, (N_SCAN, N)).astype(np.float32)
    at = np.full(N_SCAN, MIDDLE)
    score[:, MIDDLE] = 6.0
    assert evidence_ratio(score, at, EVERYWHERE, 3.0) > 100.0
    mimicked = rng.normal(0.0, 20.0, (N_SCAN, N)).astype(np.float32)
    assert 0.9 < evidence_ratio(mimicked, mimicked.argmax(axis=1), EVERYWHERE, 3.0) < 0.8 * MIN_RATIO


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("width", [0.8, 1.1, 1.5, 3.5, 7.0])
def test_a_stripe_alone_is_no_dark_one(width: float, phase: float) -> None:
    """A noise-free bell through the matched filter itself, wherever it lies between its offsets."""
    for shift in range(OFFSET_STEP):
        place = 100.0 + shift + phase
        residual = 50.0 * np.exp(-0.5 * ((np.arange(200.0) - place) / width) ** 2).astype(np.float32)[None]
        offsets = np.arange(-60, 61, OFFSET_STEP)
        score = np.empty((1, len(offsets)), np.float32)
        lines = np.array([100.0]), np.array([width]), np.zeros(1, np.int64)
        matched_filter(residual, np.zeros_like(residual), 0.0, 1.0, *lines, offsets, 1, score)
        worst, reach_px = own_lobes(width)
        path = score.argmax(axis=1)
        assert -score.min() / score.max() <= worst * 1.01
        away = np.abs(np.arange(len(offsets)) - path[0]) * OFFSET_STEP > reach_px
        assert np.abs(score[0, away]).max() < 0.02 * score.max()
        assert evidence_ratio(score, path, EVERYWHERE[:1], width) == math.inf


def test_the_path_is_where_the_stripe_was_found() -> None:
    offsets = np.arange(-20, 21, OFFSET_STEP)
    expected = np.full(6, 50.0)
    at = path_of(offsets, 1, expected, np.array([49.6, np.nan, 29.6, 70.0, 27.6, 71.6]))
    np.testing.assert_array_equal(at, [10, -1, 0, 20, -1, -1])


@pytest.mark.parametrize("joint", ["v_groove", "butt"])
def test_a_narrow_look_at_a_joint_that_lies_askew_keeps_its_stripe(joint: str) -> None:
    """Its ends lie beside the offsets that were asked: the dark flank there is the stripe's own."""
    setup = small_setup(joint)
    tilted = replace(setup, effects={"surface_tilt": {"roll_deg": 7.0, "pitch_deg": 0.0}})
    tracker, seam = Tracker(setup), SeamLine(0.0, 0.33, 0.2)
    tracks = []
    for n in range(5):
        pose = pose_at(3.0 * n)
        tracks.append(tracker.step(frame_of(setup, pose, seam, arc=0.0, index=n, of=tilted), pose))
    # A butt's gap of little evidence waits for a second frame.
    assert all(track.valid for track in tracks[1:])


def test_path_and_rim_are_their_plain_twins() -> None:
    rng = np.random.default_rng(SEED)
    offsets = np.arange(-20, 21, OFFSET_STEP)
    for _ in range(50):
        expected = ExpectedStripe(
            *rng.uniform([[10.0], [1.0], [0.0]], [[90.0], [9.0], [1e-9]], (3, 30)),
            *(rng.random((2, 30)) < 0.7),
            np.zeros(30, np.int64),
            9.0,
        )
        position = expected.position_px + rng.normal(0.0, 9.0, 30)
        position[rng.random(30) < 0.3] = np.nan
        held = np.isfinite(position)
        off = np.nan_to_num(position) - expected.position_px + 20
        nearest = np.rint(off / OFFSET_STEP)
        want = np.where(held & (nearest >= 0) & (nearest < len(offsets)), nearest, -1)
        np.testing.assert_array_equal(path_of(offsets, 1, expected.position_px, position), want)
        at = np.where(held, position, expected.position_px)
        leaves = (at < expected.sigma_px) | (at > 99 - expected.sigma_px)
        assert leaves_image(position, *of_lines(expected), 100) == bool(leaves[expected.shown].any())


def test_lines_that_would_show_it_and_do_not_are_counted() -> None:
    """100 lines hold a stripe of 4000 e-; of the others some are as dark, some too bright, some saturated."""
    width, amplitude_e, dark_e2 = 3.0, 4000.0, 2500.0
    expected = ExpectedStripe(
        *np.tile([[30.0], [width], [0.0]], N_SCAN), EVERYWHERE, EVERYWHERE, ONE_FACE, width
    )
    position, amplitude = np.full((2, N_SCAN), np.nan)
    position[:100], amplitude[:100] = 30.0, amplitude_e
    variance, censored = np.full((N_SCAN, N), dark_e2, np.float32), np.zeros((N_SCAN, N), np.bool_)
    args = expected, position, amplitude, variance, 1.0, 0.0, censored, False
    assert seen_share(*args) == pytest.approx(0.5)
    censored[100:120, 7] = True
    variance[120:140, 50] = 1e9
    assert seen_share(*args) == pytest.approx(100.0 / 160.0)
    assert seen_share(expected._replace(shown=np.arange(N_SCAN) < 150), *args[1:]) == pytest.approx(
        100.0 / 110.0
    )
    # A quarter of what was found, by the filter itself, whose template of whole pixels sees a little more.
    r = np.arange(N)
    bell = np.exp(-0.5 * ((r - 30.0) / width) ** 2)
    score = np.empty((1, 1), np.float32)
    where = np.array([30.0]), np.array([width]), np.zeros(1, np.int64), np.zeros(1, np.int64), 1
    residual = (0.25 * amplitude_e * bell).astype(np.float32)[None]
    matched_filter(residual, np.zeros_like(residual), 0.0, dark_e2, *where, score)
    just = dark_e2 * (float(score[0, 0]) / CLEAR_SIGMAS) ** 2
    for factor, share in ((0.65, 0.5), (1.05, 1.0)):
        even = np.full((N_SCAN, N), factor * just, np.float32)
        assert seen_share(
            expected, position, amplitude, even, 1.0, 0.0, np.zeros_like(censored), False
        ) == pytest.approx(share)
    nothing = np.full(N_SCAN, np.nan)
    assert np.isnan(seen_share(expected, nothing, nothing, variance, 1.0, 0.0, censored, False))


def test_beyond_the_ends_of_an_unstated_fan_nothing_is_missed() -> None:
    """A fan lights 80 of 200 lines and misses three amid them; what lies astray is no stripe of it."""
    expected = ExpectedStripe(*np.tile([[30.0], [3.0], [0.0]], N_SCAN), EVERYWHERE, EVERYWHERE, ONE_FACE, 3.0)
    variance, censored = np.full((N_SCAN, N), 2500.0, np.float32), np.zeros((N_SCAN, N), np.bool_)

    def share(holds: np.ndarray, seeks_ends: bool) -> float:
        position, amplitude = np.where(holds, 30.0, np.nan), np.where(holds, 4000.0, np.nan)
        return seen_share(expected, position, amplitude, variance, 1.0, 0.0, censored, seeks_ends)

    lines = np.arange(N_SCAN)
    fan = (lines >= 60) & (lines < 140) & ~np.isin(lines, (80, 81, 100))
    assert share(fan, False) == pytest.approx(77.0 / N_SCAN)
    assert share(fan, True) == pytest.approx(77.0 / 80.0)
    astray = np.isin(lines, (0, 10, 20))
    assert share(fan | astray, True) == pytest.approx(77.0 / 83.0)
    # So narrow a fan must be stated.
    narrow = (lines >= 60) & (lines < 126)
    assert share(narrow, True) == pytest.approx(66.0 / N_SCAN)
    assert share(narrow | (lines == 126), True) == 1.0
    # Lines that hold it by turns show no fan.
    assert share(lines % 4 < 2, True) == pytest.approx(0.5)


def plain_seen_share(
    expected: ExpectedStripe,
    position: np.ndarray,
    amplitude: np.ndarray,
    background: np.ndarray,
    shot: float,
    dark: float,
    censored: np.ndarray,
    seeks_ends: bool,
) -> float:
    """Return `seen_share` by whole arrays."""
    holds = np.isfinite(position)
    weak = WEAK * np.median(amplitude[holds])
    worst = np.where(censored.any(axis=1), np.inf, shot * background.max(axis=1) + dark)
    absent = expected.shown & (weak * np.sqrt(0.52 * expected.sigma_px / worst) > CLEAR_SIGMAS) & ~holds
    total = np.concatenate([[0.0], np.cumsum(holds - ABSENT_COST * absent)])
    end = int(np.argmax(total - np.minimum.accumulate(total)))
    lit = slice(int(np.argmin(total[: end + 1])), end)
    n_found, n_absent = holds.sum(), absent.sum()
    if seeks_ends and holds[lit].sum() >= MIN_FAN_SHARE * expected.shown.sum():
        n_found, n_absent = holds[lit].sum(), absent[lit].sum() + n_found - holds[lit].sum()
    return n_found / (n_found + n_absent)


@pytest.mark.parametrize("seeks_ends", [False, True])
def test_the_share_that_is_seen_is_its_twins(seeks_ends: bool) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        n = int(rng.integers(30, 90))
        expected = ExpectedStripe(
            rng.uniform(20.0, 60.0, n),
            rng.uniform(1.0, 4.0, n),
            np.zeros(n),
            rng.random(n) < 0.9,
            np.ones(n, np.bool_),
            np.zeros(n, np.int64),
            4.0,
        )
        holds = np.abs(np.arange(n) - rng.uniform(0.3, 0.7) * n) < rng.uniform(0.1, 0.5) * n
        holds &= rng.random(n) < 0.95
        holds[n // 2] = True
        position = np.where(holds, expected.position_px, np.nan)
        amplitude = np.where(holds, rng.uniform(500.0, 3000.0, n), np.nan)
        background = rng.uniform(100.0, 4000.0, (n, 40)).astype(np.float32)
        censored = rng.random((n, 40)) < 0.002
        args = expected, position, amplitude, background, 0.9, 50.0, censored, seeks_ends
        assert seen_share(*args) == pytest.approx(plain_seen_share(*args))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from((-1, 0, 1)), min_size=1, max_size=30))
def test_a_fans_ends_are_those_of_the_best_of_all_intervals(lines: list[int]) -> None:
    holds, absent = np.array(lines) > 0, np.array(lines) < 0
    worth = holds - ABSENT_COST * absent
    best = max(worth[i:j].sum() for i in range(len(lines) + 1) for j in range(i, len(lines) + 1))
    assert worth[slice(*fan_ends(holds, absent))].sum() == pytest.approx(best)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place_mm", "turn_deg", "camera_deg", "camera_mm", "seam_mm", "level"),
    [
        # The glint's rim, saturated, in a fifth of the lines.
        (
            (15.992, 0.491, 0.281),
            (3.141, -2.971, -2.793),
            (-0.036, 0.04, 0.009),
            (-0.002, -0.042, -0.03),
            (0.924, 0.717),
            0.355,
        ),
        # An edge of the arc's light where the map has it elsewhere, gone once the map is there too.
        (
            (-52.444, 1.836, -0.511),
            (-0.466, -0.667, -0.097),
            (-0.116, 0.002, 0.033),
            (0.016, 0.016, -0.046),
            (0.154, -0.53),
            3.91,
        ),
        (
            (7.649, 0.915, -1.185),
            (-0.726, -2.194, 1.609),
            (-0.05, 0.035, 0.046),
            (-0.01, 0.071, -0.034),
            (0.313, -0.229),
            2.138,
        ),
    ],
)
def test_an_arc_in_bare_corrugated_steel_is_no_stripe(
    place_mm: tuple[float, ...],
    turn_deg: tuple[float, ...],
    camera_deg: tuple[float, ...],
    camera_mm: tuple[float, ...],
    seam_mm: tuple[float, float],
    level: float,
) -> None:
    setup = small_setup("corrugation")
    setup = replace(setup, material=TABLE_1["mild_steel"], arc=replace(setup.arc, radiance_e=3.85e7))
    pose, off = pose_at(*place_mm, turn_deg), pose_at(*camera_mm, camera_deg).T_base_tool
    camera = replace(setup.camera, T_tool_camera=setup.camera.T_tool_camera @ off)
    true, seam = replace(setup, camera=camera), SeamLine(0.0, *seam_mm)
    for index in range(4):
        frame = frame_of(true, pose, seam, laser=0.0, arc=level, index=index)
        track = Tracker(setup).step(replace(frame, laser_on=True), pose)
        assert not track.valid, track.flag_names


def of_lines(expected: ExpectedStripe) -> tuple[Float64, Float64, Bool]:
    """What is expected, as kernels take it."""
    return expected.position_px, expected.sigma_px, expected.shown


def test_a_stripe_off_the_image_is_told() -> None:
    expected = ExpectedStripe(
        np.linspace(20.0, 90.0, 71),
        np.full(71, 3.0),
        np.zeros(71),
        *np.ones((2, 71), dtype=np.bool_),
        np.zeros(71, np.int64),
        3.0,
    )
    nowhere = np.full(71, np.nan)
    assert not leaves_image(nowhere, *of_lines(expected), 100)
    assert leaves_image(nowhere, *of_lines(expected), 90)
    # What was found counts for more than what was expected.
    assert not leaves_image(np.linspace(10.0, 80.0, 71), *of_lines(expected), 90)
    assert leaves_image(np.linspace(-1.0, 80.0, 71), *of_lines(expected), 90)
    deep = expected._replace(shown=expected.position_px < 80.0)
    assert not leaves_image(nowhere, *of_lines(deep), 90)


@pytest.mark.parametrize("joint", JOINTS)
def test_a_weak_stripe_is_still_a_stripe(joint: str) -> None:
    setup, pose, seam = small_setup(joint), pose_at(0.0), SeamLine(0.0, 0.5, 0.3)
    for i, arc in enumerate((0.0, 0.5)):
        track = Tracker(setup).step(frame_of(setup, pose, seam, laser=0.1, arc=arc, index=i), pose)
        assert track.valid, track.flag_names
        assert "two_stripes" not in track.flag_names


@pytest.mark.slow
@pytest.mark.parametrize("joint", JOINTS)
def test_blocks_of_random_codes_hold_no_stripe(joint: str) -> None:
    setup, pose = small_setup(joint), pose_at(0.0)
    rng, tracker, tracked = np.random.default_rng(SEED), Tracker(setup), 0
    shape = setup.camera.height, setup.camera.width
    for i in range(40):
        size = int(rng.integers(2, 33))
        blocks = rng.integers(0, 256, (shape[0] // size + 1, shape[1] // size + 1))
        image = np.kron(blocks, np.ones((size, size)))[: shape[0], : shape[1]].astype(np.uint8)
        tracked += tracker.step(Frame(i, 0.1 * i, image, EXPOSURE_S, CURRENT_A), pose).valid
    # An edge joint stands in few scan lines: a few blocks may fill them.
    assert tracked <= (1 if joint == "edge" else 0)


def test_a_tool_so_low_that_the_stripe_leaves_the_image_is_flagged() -> None:
    setup = small_setup("v_groove")
    assert (
        "stripe_leaves_image"
        not in Tracker(setup).step(frame_of(setup, pose_at(0.0)), pose_at(0.0)).flag_names
    )
    told = []
    for z_mm in np.arange(38.0, 50.0, 2.0):
        pose = pose_at(0.0, 0.0, z_mm)
        told.append("stripe_leaves_image" in Tracker(setup).step(frame_of(setup, pose), pose).flag_names)
    assert 0 < sum(told) < len(told)
