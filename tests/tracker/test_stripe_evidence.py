"""What tells a stripe from the arc's map's own misses, a second stripe, and one that leaves the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered import CURRENT_A, EXPOSURE_S, SEED, frame_of, pose_at, small_setup

from noise_model.surface import SeamLine
from tracker.expected import ExpectedStripe
from tracker.state import Frame
from tracker.step import Tracker
from tracker.stripe_evidence import (
    CHANCE_SIGMAS,
    GHOST_SIGMAS,
    LEAST_RATIO,
    LOBE,
    evidence_ratio,
    has_ghost,
    leaves_image,
    path_of,
)
from tracker.stripe_path import GAIN_CAP, OFFSET_STEP, matched_filter

N_SCAN, N, MIDDLE = 200, 60, 30
EVERYWHERE = np.ones(N_SCAN, dtype=np.bool_)
JOINTS = ("v_groove", "lap", "corrugation", "butt", "fillet", "half_v", "u_groove", "edge")


def ratio_plainly(score: np.ndarray, at: np.ndarray, shown: np.ndarray) -> float:
    found = np.where(at >= 0, np.maximum(np.take_along_axis(score, at[:, None], 1)[:, 0], 0.0), 0.0)
    dark = np.where(shown | (at >= 0), -score.min(axis=1), 0.0)
    beside = np.where(at >= 0, found, found[at >= 0].mean())
    dark = dark[dark > np.maximum(LOBE * beside, CHANCE_SIGMAS)]
    against = np.minimum(dark**2 / 2, GAIN_CAP).sum()
    return float(np.minimum(found**2 / 2, GAIN_CAP).sum() / against) if against else np.inf


def test_the_ratio_is_its_plain_twins() -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(20):
        score = rng.normal(0.0, rng.uniform(0.5, 8.0), (N_SCAN, N)).astype(np.float32)
        at = rng.integers(-1, N, N_SCAN)
        shown = rng.random(N_SCAN) < 0.7
        assert evidence_ratio(score, at, shown) == pytest.approx(ratio_plainly(score, at, shown), rel=1e-5)


def test_noise_is_no_evidence_and_either_sign_alike_is_a_tie() -> None:
    rng = np.random.default_rng(SEED)
    score = rng.normal(0.0, 1.0, (N_SCAN, N)).astype(np.float32)
    at = np.full(N_SCAN, MIDDLE)
    score[:, MIDDLE] = 6.0
    assert evidence_ratio(score, at, EVERYWHERE) > 100.0
    mimicked = rng.normal(0.0, 20.0, (N_SCAN, N)).astype(np.float32)
    assert 0.9 < evidence_ratio(mimicked, mimicked.argmax(axis=1), EVERYWHERE) < 0.8 * LEAST_RATIO


@pytest.mark.parametrize("width", [1.5, 3.5, 7.0])
def test_a_stripes_own_lobes_stay_below_their_share(width: float) -> None:
    """A noise-free bell through the matched filter itself."""
    r = np.arange(200.0)
    residual = np.exp(-0.5 * ((r - 100.0) / width) ** 2).astype(np.float32)[None]
    offsets = np.arange(-60, 61, OFFSET_STEP)
    score = np.empty((1, len(offsets)), np.float32)
    args = residual, np.ones_like(residual), np.array([100.0]), np.array([width]), np.zeros(1, np.int64), 16
    matched_filter(*args, offsets, score)
    lobe = -score.min() / score.max()
    print(f"width {width} px: darkest lobe {lobe:.2f} of the score")
    assert 0.3 < lobe < 0.8 * LOBE


def test_the_path_is_where_the_stripe_was_found() -> None:
    offsets = np.arange(-20, 21, OFFSET_STEP)
    expected = np.array([50.4, 50.4, 50.4, 50.4])
    at = path_of(offsets, expected, np.array([50.0, np.nan, 30.0, 71.0]))
    np.testing.assert_array_equal(at, [10, -1, 0, 20])


def test_path_and_rim_are_their_plain_twins() -> None:
    rng = np.random.default_rng(SEED)
    offsets = np.arange(-20, 21, OFFSET_STEP)
    for _ in range(50):
        expected = ExpectedStripe(
            rng.uniform(10.0, 90.0, 30), rng.uniform(1.0, 9.0, 30), np.zeros(30), rng.random(30) < 0.7
        )
        position = expected.position_px + rng.normal(0.0, 9.0, 30)
        position[rng.random(30) < 0.3] = np.nan
        held = np.isfinite(position)
        off = np.nan_to_num(position) - np.rint(expected.position_px) + 20
        want = np.where(held, np.clip(np.rint(off / OFFSET_STEP), 0, len(offsets) - 1), -1)
        np.testing.assert_array_equal(path_of(offsets, expected.position_px, position), want)
        at = np.where(held, position, expected.position_px)
        leaves = (at < expected.sigma_px) | (at > 99 - expected.sigma_px)
        assert leaves_image(expected, position, 100) == bool(leaves[expected.shown].any())


@pytest.mark.parametrize(
    ("second", "share", "is_one"), [(0.8, 1.0, True), (0.3, 1.0, False), (0.8, 0.4, False)]
)
def test_a_second_stripe_is_one_that_is_alike_and_parallel(second: float, share: float, is_one: bool) -> None:
    rng = np.random.default_rng(SEED)
    score = rng.normal(0.0, 1.0, (N_SCAN, N)).astype(np.float32)
    at = (MIDDLE + 8.0 * np.sin(np.arange(N_SCAN) / 30.0)).astype(np.int64)
    rows = np.arange(N_SCAN)
    score[rows, at] = 20.0
    shown = rng.random(N_SCAN) < share
    score[rows[shown], at[shown] + 14] = 20.0 * second
    sigma = np.full(N_SCAN, 5.0)
    assert has_ghost(score, at, sigma) == is_one
    assert not has_ghost(score, at, np.full(N_SCAN, 14.5 * OFFSET_STEP / GHOST_SIGMAS))
    assert not has_ghost(score, np.full(N_SCAN, -1), sigma)


def test_a_stripe_off_the_image_is_told() -> None:
    expected = ExpectedStripe(
        np.linspace(20.0, 90.0, 71), np.full(71, 3.0), np.zeros(71), np.ones(71, dtype=np.bool_)
    )
    nowhere = np.full(71, np.nan)
    assert not leaves_image(expected, nowhere, 100)
    assert leaves_image(expected, nowhere, 90)
    # What was found counts for more than what was expected.
    assert not leaves_image(expected, np.linspace(10.0, 80.0, 71), 90)
    assert leaves_image(expected, np.linspace(-1.0, 80.0, 71), 90)
    deep = replace(expected, shown=expected.position_px < 80.0)
    assert not leaves_image(deep, nowhere, 90)


@pytest.mark.parametrize("joint", JOINTS)
def test_a_weak_stripe_is_still_a_stripe(joint: str) -> None:
    setup, pose, seam = small_setup(joint), pose_at(0.0), SeamLine(0.0, 0.5, 0.3)
    for i, arc in enumerate((0.0, 0.5)):
        track = Tracker(setup).step(frame_of(setup, pose, seam, laser=0.1, arc=arc, index=i), pose)
        assert track.valid, track.flag_names
        assert "two_stripes" not in track.flag_names


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


def test_a_ghost_beside_the_stripe_is_flagged() -> None:
    setup, pose = small_setup("v_groove"), pose_at(0.0)
    frame = frame_of(setup, pose, SeamLine(0.0, 0.0, -2.5), arc=0.0)
    alone = Tracker(setup).step(frame, pose)
    assert "two_stripes" not in alone.flag_names
    black, ghost = int(setup.sensor.black_level_dn), np.zeros_like(frame.image_dn)
    ghost[20:] = (0.7 * np.maximum(frame.image_dn[:-20].astype(float) - black, 0.0)).astype(np.uint8)
    both = replace(frame, image_dn=np.minimum(frame.image_dn.astype(int) + ghost, 255).astype(np.uint8))
    track = Tracker(setup).step(both, pose)
    assert "two_stripes" in track.flag_names


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
