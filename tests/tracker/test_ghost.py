"""A second stripe beside the first: found, taken off, and the seam held in spite of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import CURRENT_A, EXPOSURE_S, SEED, pose_at, small_setup
from scipy.stats import norm

from noise_model.arc.map import CELL
from noise_model.arc.scene import make_scene
from noise_model.compiled.median import numbers_for
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.instrument.sensor import expose
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine, seam_height_mm
from tracker.seam.locate import SeamSource, seam_point
from tracker.state import Frame, Pose, Track
from tracker.stripe.ghost import (
    MIN_GHOST_LINES,
    MIN_GHOST_SHARE,
    REACH_SIGMAS,
    REFLECTED_SHARE,
    REFLECTED_SIGMA_LN,
    SecondStripe,
    choose_of_two,
    second_light,
    second_place,
)
from tracker.stripe.line_fit.lines import N_FITTED
from tracker.tracker import Tracker

N_SCAN, DEPTH, WIDTH, AMPLITUDE_E, DARK_E2 = 160, 120, 3.5, 4000.0, 2500.0
SEAM = SeamLine(0.0, 0.5, -0.3)
AMBIGUOUS_PX = 16
"""So far apart two stripes lie about the V's place alike."""

CENTER = 55.0 + 6.0 * np.sin(np.arange(N_SCAN) / 25.0)
LOWS = np.zeros(N_SCAN // CELL, dtype=np.int64)


def bells(center: np.ndarray, amplitude: np.ndarray | float) -> np.ndarray:
    r = np.arange(DEPTH)
    return np.asarray(amplitude * np.exp(-0.5 * ((r - center[:, None]) / WIDTH) ** 2))


def asked(second_e: np.ndarray):
    """What is asked of a stripe with another one's light beside it: noise drawn, its own fit exact."""
    rng = np.random.default_rng(SEED)
    light = bells(CENTER, AMPLITUDE_E) + second_e
    charge = (light + rng.normal(0.0, np.sqrt(light + DARK_E2))).astype(np.float32)
    fits = np.column_stack(
        [CENTER, np.full(N_SCAN, 0.1), np.full(N_SCAN, AMPLITUDE_E), np.full(N_SCAN, WIDTH), np.ones(N_SCAN)]
    )
    return charge, np.zeros_like(charge), np.zeros(charge.shape, dtype=np.bool_), fits, LOWS


@pytest.mark.parametrize("apart_px", [-21.0, -14.6, 12.3, 17.0, 24.4])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_its_place_and_light_are_found(share: float, apart_px: float) -> None:
    along = share * AMPLITUDE_E * (1.0 + 0.3 * np.cos(np.arange(N_SCAN) / 40.0))
    second_e = bells(CENTER + apart_px, along[:, None])
    args = asked(second_e)
    found, apart = second_place(*args)
    light = np.empty_like(args[0])
    second_light(*args, found, apart, light)
    off_e = light - second_e
    print(f"share {found:.3f} of {share}, apart {apart:.2f} of {apart_px} px, light to {off_e.std():.0f} e-")
    assert found == pytest.approx(along.mean() / AMPLITUDE_E, abs=0.05)
    assert apart == pytest.approx(apart_px, abs=0.2)
    # A line's own amplitude has its noise, some dozen e- over the whole band.
    assert off_e.std() < 0.03 * AMPLITUDE_E


@pytest.mark.parametrize("share_on_weaker", [0.4, 0.6, 1.0])
def test_the_weaker_one_is_the_second(share_on_weaker: float) -> None:
    """Fits that follow the weaker stripe, or either here and there: its light is to be taken off."""
    apart_px, amplitude = 18.0, 0.5 * AMPLITUDE_E
    weak = bells(CENTER + apart_px, amplitude)
    args = asked(weak)
    on_weaker = np.arange(N_SCAN) < share_on_weaker * N_SCAN
    args[3][on_weaker, 0] += apart_px
    args[3][on_weaker, 2] = amplitude
    share, apart = second_place(*args)
    light = np.empty_like(args[0])
    second_light(*args, share, apart, light)
    assert share == pytest.approx(0.5, abs=0.05)
    assert apart == pytest.approx(apart_px, abs=0.3)
    assert (light - weak).std() < 0.03 * AMPLITUDE_E


def test_what_is_too_weak_too_rare_or_not_parallel_is_none() -> None:
    rng = np.random.default_rng(SEED)
    nothing = np.zeros((N_SCAN, DEPTH))
    assert second_place(*asked(nothing)) == (0.0, 0.0)
    assert second_place(*asked(bells(CENTER + 18.0, 0.8 * MIN_GHOST_SHARE * AMPLITUDE_E))) == (0.0, 0.0)
    here = rng.random(N_SCAN) < 0.7 * MIN_GHOST_LINES
    assert second_place(*asked(bells(CENTER + 18.0, 0.8 * AMPLITUDE_E) * here[:, None])) == (0.0, 0.0)
    crossing = CENTER + np.linspace(-40.0, 40.0, N_SCAN)
    assert second_place(*asked(bells(crossing, 0.8 * AMPLITUDE_E))) == (0.0, 0.0)
    # A map's wrong level or slope is no stripe.
    assert second_place(*asked(np.full((N_SCAN, DEPTH), 3000.0) + 20.0 * np.arange(DEPTH))) == (0.0, 0.0)
    charge, background, censored, fits, lows = asked(nothing)
    assert second_place(charge, background, censored, np.full_like(fits, np.nan), lows) == (0.0, 0.0)


def ghosted(setup: Setup, pose: Pose, apart_px: int, share: float, arc: float, index: int) -> Frame:
    """A frame with the stripe once more, `apart_px` rows below, as a window in front of the lens makes it."""
    arc_e = predict(setup, pose.T_base_tool, Condition(0.0, arc, EXPOSURE_S), seam=SEAM).mean_e
    laser_e = predict(setup, pose.T_base_tool, Condition(1.0, 0.0, EXPOSURE_S), seam=SEAM).mean_e
    second_e = np.zeros_like(laser_e)
    if apart_px > 0:
        second_e[apart_px:] = share * laser_e[:-apart_px]
    else:
        second_e[:apart_px] = share * laser_e[-apart_px:]
    image = expose(arc_e + laser_e + second_e, setup.sensor, np.random.default_rng(SEED + index))
    return Frame(index, 0.1 * index, image, EXPOSURE_S, CURRENT_A)


def error_mm(setup: Setup, pose: Pose, track: Track) -> np.ndarray:
    scene = make_scene(setup, pose.T_base_tool, SEAM)
    corrugation, z_mm = scene.shape.corrugation, seam_height_mm(setup.joint)
    truth = seam_point(SeamSource.of(setup), scene.T_joint_tool.tolist(), corrugation, 0.0, z_mm)
    return np.subtract(track.seam_tool_mm, truth)[1:]


@pytest.mark.slow
@pytest.mark.parametrize("arc", [0.0, 1.0])
@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_one_four_to_six_sigmas_beside_costs_no_track(joint: str, arc: float) -> None:
    """The stripe's sigma is 3.5 px in these frames; the first of two is searched, the other tracked."""
    setup = small_setup(joint)
    off = []
    for apart_px, share in ((14, 0.25), (-16, 0.25), (18, 0.9), (-18, 0.5), (20, 0.9), (22, 0.3)):
        tracker = Tracker(setup)
        for index in range(2):
            pose = pose_at(1.5 * index)
            track = tracker.step(ghosted(setup, pose, apart_px, share, arc, index), pose)
            assert track.valid, (apart_px, share, track.flag_names)
            # What is far away a narrow look does not see; it does no harm.
            assert index > 0 or abs(apart_px) > 20 or "two_stripes" in track.flag_names
            off.append(np.abs(error_mm(setup, pose, track)).max())
            # At the rim of what a narrow look reads, its place is known by one flank.
            assert off[-1] < (0.08 if abs(apart_px) < 20 else 0.12)
    print(f"{joint}, arc {arc}: {max(off):.3f} mm at most")


def test_a_brighter_one_farther_from_its_place_is_the_second() -> None:
    """A reflection may be the brighter: the seam is nearer to its nominal place."""
    setup = small_setup("v_groove")
    tracker = Tracker(setup)
    for index in range(2):
        pose = pose_at(1.5 * index)
        track = tracker.step(ghosted(setup, pose, 40, 1.4, 0.0, index), pose)
        assert track.valid, track.flag_names
        assert np.abs(error_mm(setup, pose, track)).max() < 0.12


def test_one_as_bright_and_as_near_to_its_place_refuses_the_frame() -> None:
    """Nothing says which of the two is the reflection."""
    setup = small_setup("v_groove")
    track = Tracker(setup).step(ghosted(setup, pose_at(0.0), AMBIGUOUS_PX, 0.95, 0.0, 0), pose_at(0.0))
    assert not track.valid
    assert {"stripe_ambiguous", "two_stripes"} <= set(track.flag_names)
    assert np.isnan(track.seam_tool_mm).all()


@settings(max_examples=50)
@given(st.floats(0.2, 1.0), st.floats(-20.0, 20.0), st.floats(-60.0, 60.0))
def test_the_odds_of_two_stripes_are_those_of_their_densities(share: float, off: float, apart: float) -> None:
    """A stripe at its place and its reflection's light, each by its own density, both ways round."""
    sigma_px = 20.0

    def density(stripe_px: float, strength: float) -> float:
        place = norm.logpdf(stripe_px, 0.0, sigma_px)
        return float(place + norm.logpdf(math.log(strength), math.log(REFLECTED_SHARE), REFLECTED_SIGMA_LN))

    offsets_px = np.arange(-60, 61)
    found = told(off, apart, share, offsets_px, REACH_SIGMAS * sigma_px)
    odds = density(off, share) - density(off + apart, 1.0 / share)
    assert found.nats == pytest.approx(abs(odds), rel=1e-5, abs=1e-5)
    if found.is_reflection:
        assert odds < 0.0
        near = offsets_px[found.first : found.first + found.n_offsets]
        assert np.abs(near - off - apart).max() < 0.5 * abs(apart)


def told(
    off_px: float, apart_px: float, share: float, offsets_px: np.ndarray, reach_px: float
) -> SecondStripe:
    """What lines that are all off alike tell."""
    fits, expected_px = np.full((N_SCAN, N_FITTED), 30.0 + off_px), np.full(N_SCAN, 30.0)
    room = np.empty(numbers_for(N_SCAN), np.float32)
    return choose_of_two(fits, expected_px, apart_px, share, offsets_px, reach_px, room)


def test_no_line_of_the_brighter_one_tells_no_other_place() -> None:
    assert told(math.nan, 18.0, 0.5, np.arange(9), 40.0) == (0.5, math.inf, False, 0, 9)
