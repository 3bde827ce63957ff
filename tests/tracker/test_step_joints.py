"""The whole step on rendered frames of butt, fillet, half V, U, edge, and of a joint not as stated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rendered import frame_of, pose_at, small_setup, true_seam_tool, walk

from noise_model.arc_source import NO_ARC
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import invert, transform
from tracker import checks, flags
from tracker.checks import FrameChecks
from tracker.find import Finder
from tracker.geometry import SensorGeometry
from tracker.pipeline import JOINT_CHI2_LIMIT, as_stated
from tracker.state import Frame, Pose, Track
from tracker.tracker import Tracker

SEAM = SeamLine(0.0, 0.8, -0.3, 0.004, 0.001)
NAMES = ("butt", "fillet", "ridge", "half_v", "u_groove", "edge", "outside_corner", "free")
BEAD_MM = tuple((n - 15.0, 2.0 * math.exp(-(((n - 18.0) / 3.0) ** 2))) for n in range(31))


def setup_of(name: str) -> Setup:
    if name == "free":
        setup = small_setup("v_groove")
        joint = replace(setup.joint, type="free", dimensions={}, section_mm=BEAD_MM)
        return replace(setup, joint=joint, arc=NO_ARC)
    if name != "ridge":
        return small_setup(name)
    setup = small_setup("fillet")
    ridge = replace(setup.joint, dimensions={"included_angle_deg": 240.0})
    return replace(setup, joint=ridge, arc=replace(setup.arc, center_in_tool_mm=(0.0, 0.0, 0.0)))


def u_area_mm2() -> float:
    """The area of the nominal U between root, roundings and bevels: its widths' integral over the height."""
    depth, radius, bevel = 6.0, 3.0, math.radians(20.0)
    height = np.linspace(0.0, depth, 100001)
    rounded = np.sqrt(np.maximum(radius**2 - (radius - height) ** 2, 0.0))
    straight = radius * math.cos(bevel) + (height - radius * (1.0 - math.sin(bevel))) * math.tan(bevel)
    out = np.where(height < radius * (1.0 - math.sin(bevel)), rounded, straight)
    return float(np.trapezoid(1.0 + 2.0 * out, height))


U_AREA_MM2 = u_area_mm2()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_is_tracked_in_simulated_frames(name: str) -> None:
    setup = setup_of(name)
    tracker = Tracker(setup)
    # Two sheets on edge stand in few lines: a frame's noise alone is more than any offset may be.
    seen_share, n_frames = (0.15, 20) if name == "edge" else (0.9, 5)
    errors = []
    for frame, pose in walk(setup, n_frames, SEAM):
        track = tracker.step(frame, pose)
        error = np.array(track.seam_tool_mm) - true_seam_tool(setup, pose, SEAM)
        assert track.valid, track.flag_names
        assert track.stripe is not None
        assert np.isfinite(track.stripe.position_px).mean() > seen_share, name
        assert abs(error[1]) < 0.03 or name == "edge", error
        assert abs(error[2]) < 0.03, error
        errors.append(error[1])
        assert not track.flags & (flags.JOINT_TYPE_MISMATCH.mask | flags.JOINT_MISFIT.mask), track.flag_names
    assert abs(np.mean(errors)) < 0.02, errors
    assert np.sqrt(np.mean(np.square(errors))) < 0.05, errors


@pytest.mark.slow
@pytest.mark.parametrize(("arc", "is_valid"), [(0.5, True), (1.0, True), (30.0, False)])
def test_a_free_section_is_tracked_in_an_arc_s_light_or_refused(arc: float, is_valid: bool) -> None:
    """Its light is not predicted: the stripe is read beside it, or is lost in it."""
    setup, plain = setup_of("free"), small_setup("v_groove")
    plate = replace(plain, joint=replace(plain.joint, type="flat", dimensions={}))
    pulls = []
    for n in range(4):
        pose, tracker = pose_at(5.0 * n), Tracker(setup)
        stripe = frame_of(setup, pose, SEAM, index=n)
        light = frame_of(plate, pose, laser=0.0, arc=arc, index=n)
        both = np.clip(
            stripe.image_dn.astype(np.int64) + light.image_dn, 0, np.iinfo(light.image_dn.dtype).max
        )
        track = tracker.step(replace(light, image_dn=both.astype(light.image_dn.dtype), laser_on=True), pose)
        assert track.valid == is_valid, track.flag_names
        if is_valid:
            error = np.array(track.seam_tool_mm) - true_seam_tool(setup, pose, SEAM)
            pulls.append((error[1] / track.sigma_y_mm, error[2] / track.sigma_z_mm))
    assert np.abs(pulls).max(initial=0.0) < 3.5


@pytest.mark.parametrize(
    ("name", "bevels_deg", "plates_deg", "area_mm2"),
    [
        ("butt", (math.nan, math.nan), (0.0, 0.0), 3.0),
        ("fillet", (math.nan, math.nan), (45.0, -45.0), math.nan),
        ("outside_corner", (math.nan, math.nan), (-45.0, 45.0), math.nan),
        ("half_v", (45.0, math.nan), (0.0, 0.0), 4.0 * 1.0 + 0.5 * 4.0**2),
        ("u_groove", (20.0, 20.0), (0.0, 0.0), U_AREA_MM2),
    ],
)
def test_what_a_section_shows_comes_with_the_track(
    name: str, bevels_deg: tuple[float, float], plates_deg: tuple[float, float], area_mm2: float
) -> None:
    setup = setup_of(name)
    pose = pose_at(5.0)
    shape = Tracker(setup).step(frame_of(setup, pose), pose).shape
    np.testing.assert_allclose(shape.bevel_angles_deg, bevels_deg, atol=0.8)
    np.testing.assert_allclose(shape.plate_angles_deg, plates_deg, atol=0.1)
    assert shape.area_mm2 == pytest.approx(area_mm2, rel=0.1, nan_ok=True)
    assert math.isnan(shape.area_sigma_mm2) == math.isnan(area_mm2)


@pytest.mark.parametrize(("name", "gap_mm"), [("v_groove", 0.0), ("v_groove", 0.1), ("half_v", 0.2)])
def test_a_root_too_narrow_to_be_told_from_a_closed_one_says_so(name: str, gap_mm: float) -> None:
    """The root's few columns are blurred: how deep it goes is no better known than how wide it is."""
    setup = small_setup(name)
    dimensions = {**setup.joint.dimensions, "root_gap_mm": gap_mm}
    tolerance = replace(setup.tolerance, hand_eye_deg=0.0, hand_eye_mm=0.0)
    setup = replace(setup, joint=replace(setup.joint, dimensions=dimensions), tolerance=tolerance)
    pulls = []
    for n in range(8):
        pose, seam = pose_at(3.0 * n), SeamLine(0.0, 0.17 * n - 0.6, 0.1 * n)
        track = Tracker(setup).step(frame_of(setup, pose, seam, index=n), pose)
        _, y, z = np.array(track.seam_tool_mm) - true_seam_tool(setup, pose, seam)
        pulls.append((y / track.sigma_y_mm, z / track.sigma_z_mm))
    assert (np.mean(np.square(pulls), axis=0) < 3.0).all(), pulls


def shown_twice(setup: Setup, frame: Frame, pose: Pose) -> Track:
    """The second track of a frame: one alone shows no such gap beyond doubt."""
    tracker = Tracker(setup)
    if setup.joint.type == "butt":
        assert tracker.step(frame, pose).flags & flags.JOINT_NOT_FOUND.mask
    return tracker.step(frame, pose)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "gap_mm"), [("butt", 0.5), ("edge", 0.5)])
def test_a_narrow_gap_is_as_sure_as_its_blurred_ends_are(name: str, gap_mm: float) -> None:
    """Of few scan lines: between those that surely show a plate and those that do not are some unread."""
    setup = small_setup(name)
    dimensions = {**setup.joint.dimensions, "gap_mm": gap_mm}
    tolerance = replace(setup.tolerance, hand_eye_deg=0.0, hand_eye_mm=0.0)
    setup = replace(setup, joint=replace(setup.joint, dimensions=dimensions), tolerance=tolerance)
    pulls = []
    for n in range(16):
        pose, seam = pose_at(3.0 * n), SeamLine(0.0, 0.177 * n - 1.4, 0.05 * n)
        track = shown_twice(setup, frame_of(setup, pose, seam, index=n), pose)
        y = track.seam_tool_mm[1] - true_seam_tool(setup, pose, seam)[1]
        pulls.append((y / track.sigma_y_mm, (track.gap_mm - gap_mm) / track.shape.gap_sigma_mm))
    assert (np.mean(np.square(pulls), axis=0) < 2.0).all(), pulls


def test_a_gap_that_chance_shows_at_times_is_a_seam_once_two_frames_show_it() -> None:
    setup = small_setup("butt")
    setup = replace(setup, joint=replace(setup.joint, dimensions={**setup.joint.dimensions, "gap_mm": 0.5}))
    tracker, finder = Tracker(setup), Finder(SensorGeometry.of(setup))
    frames = [
        (frame_of(setup, pose, SeamLine(0.0, 0.5, 0.1), index=n, arc=0.0), pose)
        for n, pose in enumerate((pose_at(0.0), pose_at(1.0)))
    ]
    first, second = (tracker.step(*given) for given in frames)
    assert first.flags & flags.JOINT_NOT_FOUND.mask
    assert second.valid, second.flag_names
    # A find has frames of its own, which confirm each other.
    section, _ = finder.section(*frames[0])
    assert section is not None


def narrow_butt() -> Setup:
    """A butt joint whose gap is two scan lines wide: chance loses as many in one profile of seventy."""
    setup = small_setup("butt")
    return replace(setup, joint=replace(setup.joint, dimensions={**setup.joint.dimensions, "gap_mm": 0.25}))


def test_a_gap_of_two_scan_lines_is_not_told_from_lost_lines() -> None:
    setup = narrow_butt()
    for n in range(4):
        pose, seam = pose_at(3.0 * n), SeamLine(0.0, 0.177 * n - 1.4, 0.05 * n)
        track = Tracker(setup).step(frame_of(setup, pose, seam, index=n, arc=0.0), pose)
        assert track.flags & flags.JOINT_NOT_FOUND.mask, track.flag_names


def test_the_line_of_a_narrow_gap_in_the_arc_s_light_is_its_seam() -> None:
    setup = narrow_butt()
    setup = replace(setup, tolerance=replace(setup.tolerance, hand_eye_deg=0.0, hand_eye_mm=0.0))
    pulls, by_line = [], 0
    for n in range(4):
        pose, seam = pose_at(3.0 * n), SeamLine(0.0, 0.177 * n - 1.4, 0.05 * n)
        track = shown_twice(setup, frame_of(setup, pose, seam, index=n), pose)
        assert track.valid, track.flag_names
        by_line += bool(track.flags & flags.SEAM_BY_LINE.mask)
        _, y, z = np.array(track.seam_tool_mm) - true_seam_tool(setup, pose, seam)
        pulls.append((y / track.sigma_y_mm, z / track.sigma_z_mm))
    assert by_line > 1
    assert (np.mean(np.square(pulls), axis=0) < 3.0).all(), pulls


@pytest.mark.parametrize(("stated", "there"), [("v_groove", "lap"), ("lap", "v_groove"), ("butt", "half_v")])
def test_a_joint_that_is_not_as_stated_is_told(stated: str, there: str) -> None:
    setup = small_setup(stated)
    true = replace(setup, joint=small_setup(there).joint)
    pose = pose_at(0.0)
    track = Tracker(setup).step(frame_of(setup, pose, of=true), pose)
    assert track.flags & flags.JOINT_TYPE_MISMATCH.mask, track.flag_names


@pytest.mark.parametrize(
    ("is_misfit", "is_other", "is_by_line", "is_kept"),
    [
        (True, True, False, False),
        (True, False, False, True),
        (False, True, False, True),
        (True, True, True, True),
    ],
)
def test_a_misfit_that_looks_like_another_type_is_no_joint(
    is_misfit: bool, is_other: bool, is_by_line: bool, is_kept: bool
) -> None:
    setup, pose = small_setup("lap"), pose_at(0.0)
    tracker = Tracker(setup)
    tracker.step(frame_of(setup, pose), pose)
    reading = tracker.reading
    assert reading is not None
    assert reading.joint is not None
    assert reading.stripe is not None
    asked = FrameChecks()
    asked.ask(checks.JOINT_CHI2, 20.0 if is_misfit else 1.0, JOINT_CHI2_LIMIT)
    asked.ask_whether(checks.JOINT_TYPE, not is_other)
    asked.ask_whether(checks.GAP_SHOWN, not is_by_line)
    assert (as_stated(reading._replace(checks=asked)).joint is not None) == is_kept
    assert bool(asked.flags & flags.JOINT_NOT_FOUND.mask) != is_kept


def test_the_margin_shrinks_as_the_joint_leaves_the_view() -> None:
    setup = small_setup("v_groove")
    margins = []
    for y_mm in (0.0, 2.0, 4.0):
        pose = pose_at(0.0, y_mm)
        margins.append(Tracker(setup).step(frame_of(setup, pose), pose).fov_margin_mm)
    np.testing.assert_allclose(np.diff(margins), -2.0, atol=0.15)


def with_glint(frame: Frame, setup: Setup, point_tool_mm: Float64, radius_px: int) -> Frame:
    """The frame with a saturated disc about a point of the tool frame."""
    T_camera_tool = invert(setup.camera.T_tool_camera)
    u, v = setup.camera.project(transform(T_camera_tool, point_tool_mm[None]))[0]
    image_dn = frame.image_dn.copy()
    rows, columns = np.indices(image_dn.shape)
    image_dn[(columns - u) ** 2 + (rows - v) ** 2 < radius_px**2] = 2**setup.sensor.bits - 1
    return replace(frame, image_dn=image_dn)


@pytest.mark.parametrize("away_mm", [-0.8, 1.2])
def test_a_glint_over_an_end_of_a_gap_gives_no_wrong_seam(away_mm: float) -> None:
    """What lines under it do not show is neither plate nor gap: the seam is as unsure as they are wide."""
    setup = small_setup("butt")
    setup = replace(setup, tolerance=replace(setup.tolerance, hand_eye_deg=0.0, hand_eye_mm=0.0))
    tracker = Tracker(setup)
    for n in range(3):
        pose = pose_at(1.5 * n)
        frame, truth = frame_of(setup, pose, SEAM, index=n, arc=0.0), true_seam_tool(setup, pose, SEAM)
        if n == 2:
            frame = with_glint(frame, setup, truth + np.array([0.0, away_mm, 0.0]), 6)
        track = tracker.step(frame, pose)
        if track.valid:
            error = np.array(track.seam_tool_mm) - truth
            assert abs(error[1]) < max(3.0 * track.sigma_y_mm, 0.05), (n, error, track.sigma_y_mm)


def test_a_gap_that_is_stated_wide_is_never_closed() -> None:
    """A line beside the stripe is not the seam of a joint whose gap should be seen."""
    setup = small_setup("butt")
    wide = replace(setup, joint=replace(setup.joint, dimensions={**setup.joint.dimensions, "gap_mm": 1.5}))
    there = narrow_butt()
    for n in range(3):
        pose, seam = pose_at(3.0 * n), SeamLine(0.0, 0.177 * n - 1.4, 0.05 * n)
        track = Tracker(wide).step(frame_of(wide, pose, seam, index=n, of=there), pose)
        assert not track.flags & flags.SEAM_BY_LINE.mask, track.flag_names
