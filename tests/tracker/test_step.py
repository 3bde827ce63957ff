"""The whole step: rendered frames of every joint, odd frames and poses, lost and moved seams, recordings.

The frames here come from the project's own forward model: they show that the step undoes it, and no more.
What it reaches on frames of another renderer is asked of the shared recordings, where they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from rendered import (
    CURRENT_A,
    EXPOSURE_S,
    LASER_X_MM,
    SEED,
    frame_of,
    pose_at,
    small_setup,
    true_seam_tool,
    walk,
)

from arctrack.recording import BadFrame, read_recording, read_truth
from arctrack.recording import pose_at as recorded_pose_at
from noise_model.condition import Condition
from noise_model.effects import checked
from noise_model.forward import draw_frame
from noise_model.setup import Setup
from noise_model.surface.faces import ridge
from noise_model.surface.joint import NOMINAL_SEAM, SeamLine, section
from tracker import flags
from tracker.geometry import SensorGeometry
from tracker.observation import MISFIT_LIMIT
from tracker.state import Frame, Pose, Track
from tracker.step import step
from tracker.stripe.read import Work
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory

JOINTS = ("v_groove", "lap", "corrugation")
SHARED = Path(__file__).parents[3] / "shared" / "recordings"
SHIFTED = SeamLine(0.0, 3.0, 0.5)


@pytest.fixture(scope="module")
def setups() -> dict[str, Setup]:
    return {joint: small_setup(joint) for joint in JOINTS}


@pytest.fixture
def v(setups: dict[str, Setup]) -> Setup:
    return setups["v_groove"]


def tracks(setup: Setup, seen: Iterator[tuple[Frame, Pose]], use_arc_map: bool = True) -> list[Track]:
    tracker = Tracker(setup, use_arc_map)
    return [tracker.step(frame, pose) for frame, pose in seen]


def assert_same(one: Track, other: Track) -> None:
    """Every number bit for bit."""
    for f in fields(Track):
        a, b = getattr(one, f.name), getattr(other, f.name)
        if f.name == "stripe":
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_array_equal(a.position_px, b.position_px)
                np.testing.assert_array_equal(a.sigma_px, b.sigma_px)
                np.testing.assert_array_equal(a.saturated, b.saturated)
        elif f.name == "shape":
            np.testing.assert_array_equal(np.hstack(a), np.hstack(b))
        else:
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b), err_msg=f.name)


def assert_seam(setup: Setup, track: Track, pose: Pose, seam: SeamLine, within_mm: float = 0.05) -> None:
    error = np.array(track.seam_tool_mm) - true_seam_tool(setup, pose, seam)
    assert track.valid, track.flag_names
    # A lap's edge is known to a column.
    lateral = within_mm + (0.0 if setup.joint.type == "v_groove" else 0.1)
    assert abs(error[1]) < lateral, (error, track.flag_names)
    assert abs(error[2]) < within_mm, (error, track.flag_names)


def test_a_fan_that_ends_in_the_image_is_all_of_the_stripe(v: Setup) -> None:
    """Where the setup states its end the lines beyond count for nothing, else most of the stripe is lost."""
    narrow = replace(v, laser=replace(v.laser, fan_half_angle_deg=5.0))
    frame = frame_of(v, pose_at(0.0), of=narrow)
    stated, unstated = (Tracker(setup).step(frame, pose_at(0.0)) for setup in (narrow, v))
    assert_seam(narrow, stated, pose_at(0.0), NOMINAL_SEAM)
    assert "stripe_partial" not in stated.flag_names
    assert "stripe_partial" in unstated.flag_names
    assert stated.stripe is not None
    held = np.flatnonzero(np.isfinite(stated.stripe.position_px))
    lit_mm = 2.0 * 140.0 * np.tan(np.radians(5.0))
    assert np.ptp(held) == pytest.approx(lit_mm * v.camera.fx / 140.0, rel=0.1)


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("arc", [0.0, 1.0])
@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_a_shifted_seam_is_found_and_its_offset_known(joint: str, arc: float, upright: bool) -> None:
    setup = small_setup(joint, upright=upright)
    seen = list(walk(setup, 4, SHIFTED, arc=arc))
    for (frame, pose), track in zip(seen, tracks(setup, iter(seen)), strict=True):
        assert_seam(setup, track, pose, SHIFTED)
        assert ("arc_off" in track.flag_names) == (arc == 0.0)
        assert ("searched" in track.flag_names) == (frame.index == 0)
        assert not track.map_misfit > 1.2
        assert track.seam_tool_mm[0] == pytest.approx(35.0)
        assert track.valid_at_s == track.timestamp_s
    assert track.offset_y_mm == pytest.approx(3.0, abs=0.1)
    assert track.offset_z_mm == pytest.approx(0.5, abs=0.05)
    assert track.offset_sigma_y_mm < 0.5
    assert track.arc_level == pytest.approx(arc or np.nan, abs=0.02, nan_ok=True)


def test_the_torch_on_the_measured_stretch_gets_the_seams_own_offset(v: Setup) -> None:
    seam = SeamLine(0.0, 1.0, -0.5, 0.01, 0.004)
    track = tracks(v, walk(v, 6, seam, step_mm=12.0))[-1]
    station = 60.0
    assert "offset_extrapolated" not in track.flag_names
    assert track.offset_y_mm == pytest.approx(1.0 + 0.01 * station, abs=0.03)
    assert track.offset_z_mm == pytest.approx(-0.5 + 0.004 * station, abs=0.03)
    assert track.offset_sigma_y_mm < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "off_mm", "laser", "flag"),
    [
        ("fillet", (0.0, 15.0, 0.0), 1.0, "arc_level_unknown"),
        ("butt", (35.0, 10.0, 0.0), 0.1, "map_misfit"),
        # The level is zero, and the light is there.
        ("fillet", (35.0, 10.0, 0.0), 0.1, "map_misfit"),
    ],
)
def test_frames_that_contradict_the_arc_map_are_read_without_it(
    joint: str, off_mm: tuple[float, float, float], laser: float, flag: str
) -> None:
    true = small_setup(joint)
    center_mm = np.add(true.arc.center_in_tool_mm, off_mm)
    stated = replace(true, arc=replace(true.arc, center_in_tool_mm=tuple(center_mm)))
    poses = [pose_at(x_mm) for x_mm in (5.0, 15.0, 25.0)]
    frames = [frame_of(stated, pose, SHIFTED, laser=laser, index=i, of=true) for i, pose in enumerate(poses)]
    seen = tracks(stated, zip(frames, poses, strict=True))
    for n in (0, 2):
        assert_seam(true, seen[n], poses[n], SHIFTED)
        assert ("searched" in seen[n].flag_names) == (n == 0)
    assert flag in seen[2].flag_names
    assert ("arc_off" in seen[2].flag_names) == (seen[2].arc_level == 0.0)
    assert np.isnan(seen[2].map_misfit) == (flag == "arc_level_unknown")
    for one, again in zip(seen, tracks(stated, zip(frames, poses, strict=True)), strict=True):
        assert_same(one, again)
    # The arc's own light is no stripe.
    dark = frame_of(stated, poses[0], SHIFTED, laser=1e-9, of=true)
    assert not Tracker(stated).step(dark, poses[0]).valid


@pytest.mark.slow
def test_a_frame_that_contradicts_the_arc_map_has_the_seam_and_sigma_of_one_without_it(v: Setup) -> None:
    center_mm = tuple(np.add(v.arc.center_in_tool_mm, (12.0, 3.0, 0.0)).tolist())
    stated = replace(v, arc=replace(v.arc, center_in_tool_mm=center_mm))
    for x_mm in (5.0, 15.0, 25.0):
        pose = pose_at(x_mm)
        frame = frame_of(stated, pose, SHIFTED, of=v)
        told = Tracker(stated).step(frame, pose)
        untold = Tracker(stated).step(replace(frame, arc_on=False), pose)
        assert told.map_misfit > MISFIT_LIMIT
        assert (told.valid, untold.valid) == (True, True)
        assert told.seam_tool_mm == untold.seam_tool_mm
        assert (told.sigma_y_mm, told.sigma_z_mm) == (untold.sigma_y_mm, untold.sigma_z_mm)


WELDING = {
    "spatter_streaks": {"rate_per_frame": 10.0, "brightness": 1.0},
    "groove_glare": {"peak_e": 5_000.0},
    "mirrored_stripe": {"strength": 0.15},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off_mm", "output", "is_told"),
    [((0.0, 0.0, 0.0), 1.0, True), ((0.0, 0.0, 0.0), 1.0, False), ((-20.0, 8.0, 3.0), 0.1, True)],
)
def test_a_seam_is_read_among_streaks_whatever_is_told_of_the_arc(
    off_mm: tuple[float, float, float], output: float, is_told: bool
) -> None:
    true = small_setup("v_groove")
    center_mm = tuple(np.add(true.arc.center_in_tool_mm, off_mm).tolist())
    arc = replace(true.arc, center_in_tool_mm=center_mm, radiance_e=output * true.arc.radiance_e)
    tracker, welding = Tracker(replace(true, arc=arc)), replace(true, effects=checked(WELDING))
    rng, n_valid = np.random.default_rng(SEED), 0
    for n in range(10):
        pose = pose_at(2.0 * n)
        image = draw_frame(welding, pose.T_base_tool, Condition(1.0, 1.0, EXPOSURE_S), rng, seam=SHIFTED)
        track = tracker.step(Frame(n, 0.1 * n, image, EXPOSURE_S, CURRENT_A, arc_on=is_told), pose)
        off = np.subtract(track.seam_tool_mm, true_seam_tool(true, pose, SHIFTED))[1:]
        sigma = np.array([track.sigma_y_mm, track.sigma_z_mm])
        assert not track.valid or (np.abs(off) < np.maximum(0.15, 4.0 * sigma)).all(), (n, off, sigma)
        n_valid += track.valid
    assert n_valid >= 9


@pytest.mark.parametrize("x_mm", [-22.0, -35.0, -10.0])
def test_a_corrugation_is_followed_in_height(setups: dict[str, Setup], x_mm: float) -> None:
    setup, seam = setups["corrugation"], SeamLine(0.0, 0.5, -0.3)
    pose = pose_at(x_mm)
    track = Tracker(setup).step(frame_of(setup, pose, seam), pose)
    u = (35.0 + x_mm + 30.0) % 60.0 - 30.0
    crest = 4.0 * (1.0 + np.cos(2.0 * np.pi * u / 30.0)) if abs(u) < 15.0 else 0.0
    assert track.valid, track.flag_names
    assert track.seam_tool_mm[1] == pytest.approx(0.5, abs=0.15)
    assert track.seam_tool_mm[2] == pytest.approx(crest - 0.3, abs=0.05)


def test_poses_off_the_programmed_path_do_not_move_the_offset(v: Setup) -> None:
    poses = [pose_at(0.0), pose_at(10.0, 1.5, -1.0), pose_at(20.0, -1.0, 2.0, (2.0, -3.0, 4.0))]
    seen = [(frame_of(v, pose, SHIFTED, index=i), pose) for i, pose in enumerate(poses)]
    for (_, pose), track in zip(seen, tracks(v, iter(seen)), strict=True):
        assert_seam(v, track, pose, SHIFTED)
        assert track.offset_y_mm == pytest.approx(3.0, abs=0.15)
        assert track.offset_z_mm == pytest.approx(0.5, abs=0.15)


def test_without_the_map_it_still_tracks(v: Setup) -> None:
    seen = list(walk(v, 3, SHIFTED))
    plain = tracks(v, iter(seen), use_arc_map=False)
    for (_, pose), track in zip(seen, plain, strict=True):
        assert_seam(v, track, pose, SHIFTED, within_mm=0.3)
    with_map = tracks(v, iter(seen))
    assert plain[-1].seam_tool_mm != with_map[-1].seam_tool_mm


# Frames and poses that hold nothing to track.


def unknown(track: Track) -> bool:
    numbers = (*track.seam_tool_mm, track.sigma_y_mm, track.offset_y_mm, track.offset_z_mm, track.gap_mm)
    return not track.valid and all(np.isnan(number) for number in (*numbers, track.confidence))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320), np.uint16),
        np.zeros((240, 320), np.float32),
        np.zeros((320, 240), np.uint8),
        np.zeros((240, 320, 1), np.uint8),
        np.zeros((0, 0), np.uint8),
        np.zeros(240 * 320, np.uint8),
    ],
)
def test_a_frame_of_the_wrong_kind_is_flagged(v: Setup, image: np.ndarray) -> None:
    with pytest.warns(UserWarning, match=r"^frame 4 (is|has|holds) "):
        track = Tracker(v).step(Frame(4, 0.4, image, 0.005), pose_at(0.0))
    assert track.flag_names == ("frame_unreadable",)
    assert unknown(track)
    assert track.frame == 4


def test_no_pose_and_an_old_pose_are_flagged(v: Setup) -> None:
    pose = pose_at(0.0)
    frame = frame_of(v, pose)
    assert Tracker(v).step(frame, None).flag_names == ("pose_refused",)
    extrapolated = Tracker(v).step(frame, replace(pose, extrapolated=True))
    assert extrapolated.valid
    assert "pose_extrapolated" in extrapolated.flag_names


def test_laser_off_measures_the_arc_alone(v: Setup) -> None:
    pose = pose_at(0.0)
    tracker = Tracker(v)
    track = tracker.step(frame_of(v, pose, laser=0.0, arc=1.4), pose)
    assert track.flag_names == ("laser_off", "searched", "offset_unknown")
    assert track.arc_level == pytest.approx(1.4, abs=0.02)
    assert unknown(track)
    assert tracker.state.lost == 0


def odd_images(v: Setup) -> Iterator[tuple[str, np.ndarray]]:
    rng = np.random.default_rng(SEED)
    shape = (v.camera.height, v.camera.width)
    yield "black", np.zeros(shape, np.uint8)
    yield "white", np.full(shape, 255, np.uint8)
    yield "at the black level", np.full(shape, 4, np.uint8)
    yield "random", rng.integers(0, 256, shape).astype(np.uint8)
    yield "salt", np.where(rng.random(shape) < 0.02, 255, 4).astype(np.uint8)
    row = np.arange(shape[0])[:, None] + np.zeros(shape)
    yield "half white", np.where(row < shape[0] // 2, 255, 4).astype(np.uint8)
    yield "one row", np.where(row == 120, 255, 4).astype(np.uint8)


@pytest.mark.parametrize("use_arc_map", [True, False])
@pytest.mark.parametrize("joint", JOINTS)
def test_odd_frames_hold_no_seam_and_never_raise(
    setups: dict[str, Setup], joint: str, use_arc_map: bool
) -> None:
    setup, pose = setups[joint], pose_at(0.0)
    for name, image in odd_images(setup):
        for laser_on in (True, False):
            tracker = Tracker(setup, use_arc_map)
            track = tracker.step(Frame(0, 0.0, image, 0.005, 100.0, laser_on), pose)
            assert unknown(track), (name, track.flag_names)
            assert track.flags & flags.INVALIDATING, name
            assert tracker.state.history.n == 0


def test_an_exact_black_level_and_no_light_do_not_raise(v: Setup) -> None:
    exact = replace(v, tolerance=replace(v.tolerance, black_level_dn=0.0))
    for _, image in odd_images(v):
        Tracker(exact).step(Frame(0, 0.0, image, 0.005), pose_at(0.0))
    pose = pose_at(0.0)
    assert Tracker(exact).step(frame_of(exact, pose, arc=0.0), pose).valid


@pytest.mark.parametrize(
    ("current_a", "exposure_s"),
    [(np.nan, 0.005), (0.0, 0.005), (np.inf, 0.005), (100.0, 0.0), (100.0, np.nan)],
)
def test_unknown_conditions_do_not_raise(v: Setup, current_a: float, exposure_s: float) -> None:
    pose = pose_at(0.0)
    frame = replace(frame_of(v, pose), current_a=current_a, exposure_s=exposure_s)
    track = Tracker(v).step(frame, pose)
    assert track.valid or unknown(track)


def test_codes_beyond_the_sensors_bits_do_not_raise(v: Setup) -> None:
    sensor = replace(v.sensor, bits=12, gain_e_per_dn=5.0, black_level_dn=64.0)
    setup, pose = replace(v, sensor=sensor), pose_at(0.0)
    image = np.random.default_rng(SEED).integers(0, 65536, (240, 320)).astype(np.uint16)
    assert unknown(Tracker(setup).step(Frame(0, 0.0, image, 0.005), pose))
    assert_seam(setup, Tracker(setup).step(frame_of(setup, pose, SHIFTED), pose), pose, SHIFTED)


@pytest.mark.slow
def test_odd_poses_never_raise(setups: dict[str, Setup]) -> None:
    rng = np.random.default_rng(SEED)
    turns = [
        (0, 0, 90),
        (0, 0, 180),
        (180, 0, 0),
        (0, 90, 0),
        (0, -90, 0),
        (90, 0, 0),
        (0, 45, 0),
        (0, 0, 89.9),
    ]
    shifts = [(0, 0, -300), (0, 0, -139.9), (0, 0, 400), (0, 0, 1e5), (0, 1e4, 0), (1e6, 0, 0)]
    poses = [pose_at(0.0, turn_deg=turn) for turn in turns] + [pose_at(*shift) for shift in shifts]
    for _ in range(25):
        turn = rng.normal(0.0, rng.choice([3.0, 30.0, 120.0]), 3)
        poses.append(pose_at(*rng.normal(0.0, rng.choice([3.0, 30.0, 3000.0]), 3), turn_deg=tuple(turn)))
    poses.append(Pose(np.full((4, 4), np.nan)))
    for setup in setups.values():
        good = pose_at(0.0)
        frame = frame_of(setup, good)
        geometry, work = SensorGeometry.of(setup), Work.of(SensorGeometry.of(setup))
        learned, track, _ = step(geometry, TrackerMemory(), frame, good, work)
        assert track.valid
        for pose in poses:
            for state in (TrackerMemory(), learned):
                _, track, _ = step(geometry, state, frame, pose, work)
                assert track.valid or np.isnan(track.offset_y_mm) or track.flags & flags.INVALIDATING


@pytest.mark.parametrize("odd", [(0, 0, 2.0), (0, 0, 1e12), (1, 1, -1.0), (3, 0, 1.0), (2, 3, np.inf)])
def test_numbers_that_are_no_pose_are_refused(setups: dict[str, Setup], odd: tuple[int, int, float]) -> None:
    row, column, number = odd
    for setup in setups.values():
        pose = pose_at(0.0)
        frame = frame_of(setup, pose)
        pose.T_base_tool[row, column] = number
        track = Tracker(setup).step(frame, pose)
        assert track.flag_names == ("pose_refused",)
        assert unknown(track)


# What a step depends on.


@pytest.mark.slow
def arrays_of(scratch: object) -> Iterator[np.ndarray]:
    """Every array of nested scratch."""
    if isinstance(scratch, np.ndarray):
        yield scratch
    elif isinstance(scratch, tuple):
        for part in scratch:
            yield from arrays_of(part)


def test_the_scratch_and_the_run_do_not_matter(setups: dict[str, Setup]) -> None:
    for joint in JOINTS:
        setup = setups[joint]
        geometry = SensorGeometry.of(setup)
        for use_arc_map in (True, False):
            state, clean = TrackerMemory(), Work.of(geometry)
            for frame, pose in walk(setup, 2, SHIFTED):
                for array in arrays_of(clean):
                    array[...] = 0
                next_state, track, _ = step(geometry, state, frame, pose, clean, use_arc_map)
                dirty = Work.of(geometry)
                for n, array in enumerate(arrays_of(dirty)):
                    array[...] = np.nan if array.dtype.kind == "f" and n % 2 else 100
                _, again, _ = step(geometry, state, frame, pose, dirty, use_arc_map)
                assert_same(track, again)
                state = next_state


def test_a_second_run_is_bit_for_bit_the_first(v: Setup) -> None:
    seen = list(walk(v, 3, SHIFTED))
    for one, other in zip(tracks(v, iter(seen)), tracks(v, iter(seen)), strict=True):
        assert_same(one, other)


@pytest.mark.slow
def test_the_frame_is_not_written_to(v: Setup) -> None:
    pose = pose_at(0.0)
    frame = frame_of(v, pose)
    before = frame.image_dn.copy()
    frame.image_dn.flags.writeable = False
    assert Tracker(v).step(frame, pose).valid
    np.testing.assert_array_equal(frame.image_dn, before)


# A seam that moves or hides.


@pytest.mark.slow
@pytest.mark.parametrize("arc", [0.0, 1.0])
@pytest.mark.parametrize("gamma", [0.7, 1.0, 1.35, 2.0])
def test_a_bent_response_is_as_good_as_a_straight_one(v: Setup, gamma: float, arc: float) -> None:
    """Steep in the dark, where a code is many electrons: where the stripe is it is not."""
    setup = replace(v, sensor=replace(v.sensor, gamma=gamma))
    tracker, errors, sigmas, aside = Tracker(setup), [], [], SeamLine(0.0, 1.0, -0.5)
    for frame, pose in walk(setup, 6, aside, arc=arc):
        track = tracker.step(frame, pose)
        assert track.valid
        true = true_seam_tool(setup, pose, aside)
        errors.append(np.array(track.seam_tool_mm) - true)
        sigmas.append(np.nanmedian(track.stripe.sigma_px))
    assert np.abs(errors).max() < 0.1
    assert np.median(sigmas) < 0.1


@pytest.mark.slow
def test_what_shows_elsewhere_over_a_short_way_or_now_and_then_is_not_learned(v: Setup) -> None:
    jumped = SeamLine(0.0, 0.8, 0.0)
    for step_mm, blind in ((0.3, 0), (2.0, 2)):
        tracker = Tracker(v)
        for frame, pose in walk(v, 4):
            assert tracker.step(frame, pose).valid
        for frame, pose in walk(v, 5, jumped, step_mm=step_mm, start_mm=32.0):
            assert "seam_jump" in tracker.step(frame, pose).flag_names
            for _ in range(blind):
                dark = replace(frame_of(v, pose, jumped, laser=0.0), laser_on=True)
                assert not tracker.step(dark, pose).valid
        back = [tracker.step(*seen) for seen in walk(v, 2, start_mm=42.0)]
        assert all("seam_jump" not in track.flag_names for track in back)


def test_a_jump_is_flagged_and_then_learned(v: Setup) -> None:
    tracker = Tracker(v)
    for frame, pose in walk(v, 4):
        assert tracker.step(frame, pose).valid
    jumped = SeamLine(0.0, 0.8, 0.0)
    found = [tracker.step(*seen) for seen in walk(v, 5, jumped, step_mm=1.0, start_mm=40.0)]
    assert ["seam_jump" in track.flag_names for track in found] == [True, True, True, False, False]
    assert [track.valid for track in found] == [False, False, False, True, True]
    assert found[-1].seam_tool_mm[1] == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize("roll_deg", [-5.0, 3.0, 5.0])
@pytest.mark.parametrize("joint", ["lap", "corrugation"])
def test_a_rolled_lap_is_found(setups: dict[str, Setup], joint: str, roll_deg: float) -> None:
    setup, seam, pose = setups[joint], SeamLine(0.0, 0.33, 0.2), pose_at(0.0)
    rolled = replace(setup, effects={"surface_tilt": {"roll_deg": roll_deg}})
    track = Tracker(setup).step(frame_of(setup, pose, seam, of=rolled), pose)
    assert track.valid, track.flag_names
    cos, sin = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    height_mm = 0.2 + ridge(LASER_X_MM, section(setup.joint).corrugation)[0]
    assert track.seam_tool_mm[1] == pytest.approx(0.33 * cos - height_mm * sin, abs=0.25)
    assert track.seam_tool_mm[2] == pytest.approx(0.33 * sin + height_mm * cos, abs=0.05)


def test_a_seam_that_leaves_the_band_is_searched_and_learned(v: Setup) -> None:
    tracker = Tracker(v)
    for frame, pose in walk(v, 4):
        assert tracker.step(frame, pose).valid
    sunk = SeamLine(0.0, 1.0, -4.0)
    found = [tracker.step(*seen) for seen in walk(v, 10, sunk, step_mm=1.0, start_mm=40.0)]
    assert not any(track.valid for track in found[:3])
    assert "searched" in found[3].flag_names
    assert found[-1].valid
    assert_seam(v, found[-1], pose_at(49.0), sunk)


def test_one_hidden_frame_changes_nothing(v: Setup) -> None:
    seen = list(walk(v, 5, SHIFTED))
    dark = replace(seen[3][0], image_dn=np.full_like(seen[3][0].image_dn, 4))
    found = tracks(v, iter([*seen[:3], (dark, seen[3][1]), seen[4]]))
    assert [track.valid for track in found] == [True, True, True, False, True]
    assert "stripe_lost" in found[3].flag_names
    assert "searched" not in found[4].flag_names


def test_a_saturated_stripe_is_flagged_and_tracked(v: Setup) -> None:
    pose = pose_at(0.0)
    track = Tracker(v).step(frame_of(v, pose, SHIFTED, laser=8.0), pose)
    assert "saturated" in track.flag_names
    assert_seam(v, track, pose, SHIFTED)


def test_a_stripe_over_part_of_the_frame_is_partial(v: Setup) -> None:
    pose = pose_at(0.0)
    frame = frame_of(v, pose)
    dark = frame_of(v, pose, laser=0.0, index=1)
    image = frame.image_dn.copy()
    image[:, :100] = dark.image_dn[:, :100]
    track = Tracker(v).step(replace(frame, image_dn=image), pose)
    assert "stripe_partial" in track.flag_names
    assert_seam(v, track, pose, NOMINAL_SEAM)


@pytest.mark.slow
@pytest.mark.parametrize("joint", JOINTS)
def test_arc_light_without_a_stripe_is_lost(setups: dict[str, Setup], joint: str) -> None:
    """Lines whose whole length runs along a sharp edge of the map are all that may be taken for a stripe."""
    setup = setups[joint]
    lines = 0
    for i in range(6):
        pose = pose_at(9.0 * i - 40.0)
        track = Tracker(setup).step(replace(frame_of(setup, pose, laser=0.0, index=i), laser_on=True), pose)
        assert "stripe_lost" in track.flag_names, track.flag_names
        assert unknown(track)
        assert track.stripe is not None
        lines += int(np.isfinite(track.stripe.position_px).sum())
    print(f"{joint}: {lines} of {6 * 320} scan lines without a stripe hold one")
    assert lines <= 0.02 * 6 * 320


@pytest.mark.skipif(not SHARED.exists(), reason="../shared/recordings is not there")
@pytest.mark.parametrize("name", ["v_nominal", "v_off_nominal_seam", "lap_nominal", "cor_nominal"])
def test_the_recordings_of_another_renderer_are_tracked(name: str) -> None:
    recording = read_recording(SHARED / name)
    truth, poses, tracker = read_truth(recording.path), recording.pose_buffer(), Tracker(recording.setup)
    assert truth is not None
    at = dict(zip(truth.frames.tolist(), truth.seam_tool_mm, strict=True))
    errors = []
    for frame in recording.frames():
        assert not isinstance(frame, BadFrame)
        track = tracker.step(frame, recorded_pose_at(poses, frame.timestamp_s))
        if frame.laser_on and frame.arc_on:
            assert track.valid, (frame.index, track.flag_names)
            errors.append((np.array(track.seam_tool_mm) - at[frame.index])[1:])
    constant = np.mean(errors, axis=0)
    rest = errors - constant
    rms, largest = np.sqrt(np.mean(rest**2, axis=0)), np.abs(rest).max()
    print(f"{name}: {len(errors)} frames, constant {constant.round(3)} mm, rms without it {rms.round(4)} mm")
    assert (rms <= 0.05).all()
    assert largest <= 0.25


@pytest.mark.slow
@pytest.mark.parametrize("off_share", [1.0, 0.5, 0.0])
@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_a_stated_glow_stays_in_the_background_where_the_arc_is_off(joint: str, off_share: float) -> None:
    glow = {"peak_e": 30000.0, "length_mm": 15.0, "arc_off_share": off_share}
    setup = replace(small_setup(joint), effects={"hot_metal_glow": glow})
    geometry, state, seam = SensorGeometry.of(setup), TrackerMemory(), SeamLine(0.0, 0.5, 0.2)
    for n in range(8):
        pose = pose_at(4.0 * n)
        frame = frame_of(setup, pose, seam, arc=0.0, index=n)
        state, track, reading = step(geometry, state, frame, pose, Work.of(geometry))
        assert_seam(setup, track, pose, seam)
        assert np.isnan(track.arc_level)
        assert reading is not None
        # A twentieth of the glow where it is brightest.
        assert reading.arc.ambient_e < 0.05 * off_share * glow["peak_e"] + 30.0
