"""The seam where the torch stands: the look-ahead, a lost seam, the joint's ends, a corrugation's height."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import twins
from rendered import LASER_X_MM, frame_of, pose_at, small_setup, walk

from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker.checks import FrameChecks
from tracker.seam.correction import AxisCorrection, Correction
from tracker.seam.earlier_pass import KnownSeam
from tracker.seam.gaussian_process import (
    BEND_LENGTH_MM,
    BEND_SIGMA_MM,
    MODEL_SIGMA_MM,
    WIDE_SIGMA_MM,
    SeamHistory,
)
from tracker.seam.locate import SeamSource
from tracker.state import Frame, OffsetLookAhead, Pose, Track
from tracker.steer import SeamAtTorch, seam_at_torch
from tracker.tracker import Tracker

ENDLESS = (-math.inf, math.inf)
SEAM = SeamLine(0.0, 1.0, -0.5, 0.01, 0.004)
SOURCE = SeamSource.of(small_setup("v_groove"))
HOLD, EXTRAPOLATE, STOP = (Correction(when_lost=what) for what in ("hold", "extrapolate", "stop"))


@pytest.fixture(scope="module")
def v() -> Setup:
    return small_setup("v_groove")


@pytest.fixture(scope="module")
def history() -> SeamHistory:
    """A seam that drifts to the left, measured from 0 to 40 mm."""
    seam = SeamHistory()
    for station in np.arange(0.0, 41.0, 2.0):
        seam = seam.with_measurement(float(station), np.array([0.02 * station, -0.3]), np.full(2, 1e-4))
    return seam


class Told(NamedTuple):
    """What is known of the seam at the torch, and the flags that were raised."""

    seam: SeamAtTorch
    flags: int

    @property
    def displacement_mm(self) -> tuple[float, float]:
        return self.seam.displacement_mm

    @property
    def sigma_mm(self) -> tuple[float, float]:
        return self.seam.sigma_mm


def at_torch(
    correction: Correction, history: SeamHistory, torch_mm: float, stretch_mm: tuple[float, float]
) -> Told:
    frame_checks = FrameChecks()
    return Told(
        seam_at_torch(frame_checks, KnownSeam(SOURCE, history), correction, torch_mm, stretch_mm),
        frame_checks.flags,
    )


def known(seam: Told) -> bool:
    assert np.isfinite(seam.displacement_mm).all() == np.isfinite(seam.sigma_mm).all()
    return bool(np.isfinite(seam.displacement_mm).all())


def raised(seam: Told) -> tuple[str, ...]:
    return Track(0, 0.0, seam.flags).flag_names


@pytest.mark.parametrize("correction", [HOLD, EXTRAPOLATE, STOP])
def test_on_the_measured_stretch_nothing_is_lost(correction: Correction, history: SeamHistory) -> None:
    for torch_mm in (0.0, 17.0, 40.0):
        seam = at_torch(correction, history, torch_mm, ENDLESS)
        np.testing.assert_array_equal((seam.displacement_mm, seam.sigma_mm), history.at(torch_mm))
        assert seam.flags == 0


def test_what_was_lost_is_extrapolated_within_its_limits(history: SeamHistory) -> None:
    correction = replace(EXTRAPOLATE, extrapolate_mm=8.0)
    seam = at_torch(correction, history, 48.0, ENDLESS)
    np.testing.assert_array_equal((seam.displacement_mm, seam.sigma_mm), history.at(48.0))
    assert raised(seam) == ("offset_extrapolated",)
    beyond = at_torch(correction, history, 48.001, ENDLESS)
    assert not known(beyond)
    assert raised(beyond) == ("offset_extrapolated", "offset_unknown")
    sigma = float(history.at(45.0)[1].max())
    for limit, is_known in ((sigma, True), (0.999 * sigma, False)):
        tight = replace(correction, extrapolate_sigma_mm=limit)
        assert known(at_torch(tight, history, 45.0, ENDLESS)) == is_known


def test_what_was_lost_is_held_at_a_growing_sigma(history: SeamHistory) -> None:
    held = [at_torch(HOLD, history, 40.0 + d, ENDLESS) for d in (0.0, 1e-3, 3.0, 6.0, 10.0)]
    for seam in held[1:]:
        np.testing.assert_array_equal(seam.displacement_mm, held[0].displacement_mm)
        assert raised(seam) == ("offset_held",)
    sigmas = np.array([seam.sigma_mm for seam in held])
    assert (np.diff(sigmas, axis=0) > 0.0).all()
    assert sigmas[1, 0] == pytest.approx(sigmas[0, 0], rel=1e-3)
    assert (sigmas[2:] > [history.at(40.0 + d)[1] for d in (3.0, 6.0, 10.0)]).any()
    assert not known(at_torch(HOLD, history, 50.001, ENDLESS))


def test_the_sigma_of_a_held_seam_is_honest() -> None:
    """Seams drawn from the prior: the error of the place that is held, over its stated sigma, is about 1."""
    rng = np.random.default_rng(3)
    stations, torch_mm = np.arange(0.0, 41.0, 4.0), 48.0
    everywhere = np.append(stations, torch_mm)
    K = twins.seam_prior(everywhere[:, None] - everywhere, WIDE_SIGMA_MM, BEND_SIGMA_MM, BEND_LENGTH_MM)
    root = np.linalg.cholesky(K + 1e-10 * np.eye(len(K)))
    squares = []
    for _ in range(400):
        seam = root @ rng.normal(size=(len(K), 2))
        history = SeamHistory()
        for station, true in zip(stations, seam[:-1], strict=True):
            measured = true + rng.normal(0.0, math.hypot(0.05, MODEL_SIGMA_MM), 2)
            history = history.with_measurement(float(station), measured, np.full(2, 0.05**2))
        held = at_torch(HOLD, history, torch_mm, ENDLESS)
        squares.append(((held.displacement_mm - seam[-1]) / held.sigma_mm) ** 2)
    print(f"chi2 of a held seam: {np.mean(squares):.3f}")
    assert 0.85 < np.mean(squares) < 1.15


def test_before_anything_is_measured_there_nobody_is_lost(history: SeamHistory) -> None:
    """The torch that runs up to the measured stretch follows even where a lost seam stops it."""
    seam = at_torch(STOP, history, -20.0, ENDLESS)
    assert known(seam)
    assert raised(seam) == ("offset_extrapolated",)
    assert raised(at_torch(STOP, SeamHistory(), 0.0, ENDLESS)) == ("offset_unknown",)
    assert raised(at_torch(STOP, history, 41.0, ENDLESS)) == ("offset_extrapolated",)
    assert raised(at_torch(STOP, history, 41.001, ENDLESS)) == ("follow_stopped",)


def test_before_the_joint_it_is_its_start_and_past_it_nothing(history: SeamHistory) -> None:
    before = at_torch(STOP, history, -15.0, (6.0, 30.0))
    np.testing.assert_array_equal((before.displacement_mm, before.sigma_mm), history.at(6.0))
    assert raised(before) == ("before_joint",)
    assert at_torch(STOP, history, 6.0, (6.0, 30.0)).flags == 0
    assert at_torch(STOP, history, 30.0, (6.0, 30.0)).flags == 0
    # The sensor has seen something, but not yet the joint's start: nothing is lost.
    for torch_mm in (-15.0, 45.0, 59.0):
        early = at_torch(STOP, history, torch_mm, (60.0, 90.0))
        np.testing.assert_array_equal(early.displacement_mm, history.at(60.0)[0])
        assert raised(early) == ("offset_extrapolated", "before_joint")
    past = at_torch(STOP, history, 30.001, (6.0, 30.0))
    assert not known(past)
    assert raised(past) == ("past_joint",)


# Whole steps.


def interrupted(setup: Setup, n: int, dark: range, step_mm: float = 8.0) -> Iterator[tuple[Frame, Pose]]:
    """Frames along a seam, in some of which the laser fails without a word."""
    for frame, pose in walk(setup, n, SEAM, step_mm):
        if frame.index in dark:
            frame = replace(frame_of(setup, pose, SEAM, laser=0.0, index=frame.index), laser_on=True)
        yield frame, pose


def tracks(setup: Setup, correction: Correction, seen: Iterator[tuple[Frame, Pose]]) -> list[Track]:
    tracker = Tracker(setup, correction=correction)
    return [tracker.step(frame, pose) for frame, pose in seen]


@pytest.fixture(scope="module")
def lost(v: Setup) -> list[tuple[Frame, Pose]]:
    """The sensor is blind from 91 to 155 mm: the last measurement stands at 83 mm."""
    return list(interrupted(v, 20, range(7, 16)))


@pytest.mark.slow
def test_the_torch_follows_the_measured_stretch_while_the_sensor_is_blind(
    v: Setup, lost: list[tuple[Frame, Pose]]
) -> None:
    found = tracks(v, EXTRAPOLATE, iter(lost))
    for track, (_, pose) in zip(found, lost, strict=True):
        torch_mm = float(pose.T_base_tool[0, 3])
        is_blind = 7 <= track.frame < 16
        assert ("stripe_lost" in track.flag_names) == is_blind
        assert track.valid != is_blind
        if torch_mm > 93.0 and is_blind:
            assert math.isnan(track.offset_y_mm)
            assert "offset_unknown" in track.flag_names
            continue
        error_mm = abs(track.offset_y_mm - (1.0 + 0.01 * torch_mm))
        assert error_mm < 4.0 * track.offset_sigma_y_mm
        assert error_mm < 0.1 or torch_mm < 35.0
        assert ("offset_extrapolated" in track.flag_names) == (
            not 35.0 <= torch_mm <= 83.0 and track.frame < 16
        )
        assert 0.1 < track.offset_confidence < 1.0
        assert track.valid_at_s == track.timestamp_s
    # Found again, the hole that was not seen is interpolated.
    assert found[16].flag_names == ("searched",)
    assert found[11].flag_names == ("stripe_lost", "searched", "offset_extrapolated")


@pytest.mark.slow
def test_a_lost_seam_is_held(v: Setup, lost: list[tuple[Frame, Pose]]) -> None:
    found = tracks(v, HOLD, iter(lost[:13]))
    assert "offset_held" in found[11].flag_names
    assert found[11].offset_y_mm == pytest.approx(1.83, abs=0.05)
    assert found[11].offset_sigma_y_mm > found[10].offset_sigma_y_mm
    assert found[12].flag_names == ("stripe_lost", "searched", "offset_unknown", "offset_held")


@pytest.mark.slow
def test_following_that_has_stopped_stays_so(v: Setup, lost: list[tuple[Frame, Pose]]) -> None:
    found = tracks(v, STOP, iter(lost))
    assert [("follow_stopped" in track.flag_names) for track in found] == [n >= 11 for n in range(20)]
    assert all(math.isnan(track.offset_y_mm) == (track.frame >= 11) for track in found)
    assert found[-1].valid
    assert not math.isnan(tracks(v, STOP, iter(lost[16:]))[-1].offset_y_mm)


@pytest.mark.filterwarnings("ignore:frame 0 is 320 x 239:UserWarning")
def test_following_stays_stopped_in_frames_that_cannot_be_tracked(v: Setup) -> None:
    tracker = Tracker(v, correction=Correction(y=AxisCorrection(limit_mm=0.5, at_limit="stop")))
    ((frame, pose),) = walk(v, 1, SEAM)
    refused = [
        (replace(frame, image_dn=frame.image_dn[1:]), pose),
        (frame, None),
        (frame, pose_at(0.0, z_mm=-500.0)),
    ]
    before = [tracker.step(*of).flag_names for of in refused]
    assert not any("follow_stopped" in names for names in before)
    assert "follow_stopped" in tracker.step(frame, pose).flag_names
    for names, of in zip(before, refused, strict=True):
        assert set(tracker.step(*of).flag_names) == {*names, "follow_stopped"}


def test_beyond_the_limit_it_stops_both_axes_for_good(v: Setup) -> None:
    correction = Correction(z=AxisCorrection(limit_mm=0.5, at_limit="stop"))
    low, level = (SeamLine(0.0, 1.0, z_mm) for z_mm in (-0.7, 0.0))
    seen = [*walk(v, 1, low), *walk(v, 4, level, step_mm=1.0, start_mm=1.0)]
    found = tracks(v, correction, iter(seen))
    assert all("follow_stopped" in track.flag_names for track in found)
    assert all(math.isnan(track.offset_y_mm) for track in found)
    assert abs(tracks(v, Correction(), iter(seen))[-1].offset_z_mm) < 0.1


@pytest.mark.slow
def test_the_torch_stays_on_its_stretch_until_it_comes_to_a_jump(v: Setup) -> None:
    """The seam jumps by 0.8 mm at 60 mm, where the sensor is 35 mm before the torch."""
    before, after = SeamLine(0.0, 0.0, 0.0), SeamLine(0.0, 0.8, 0.0)
    seen = [
        *walk(v, 14, before, step_mm=2.0, start_mm=-4.0),
        *walk(v, 30, after, step_mm=2.0, start_mm=24.0),
    ]
    found = tracks(v, Correction(), iter(seen))
    relearned = next(n for n, track in enumerate(found) if n > 14 and "seam_jump" not in track.flag_names)
    for n, (track, (_, pose)) in enumerate(zip(found, seen, strict=True)):
        torch_mm = float(pose.T_base_tool[0, 3])
        if n < relearned or 55.0 < torch_mm < 63.0:
            continue
        assert track.offset_y_mm == pytest.approx(0.0 if torch_mm < 60.0 else 0.8, abs=0.05)
        if 32.0 < torch_mm < 55.0:
            assert not {"offset_extrapolated", "offset_held", "offset_unknown"} & set(track.flag_names)


@pytest.mark.slow
def test_a_hole_at_a_jump_is_no_lost_seam_and_what_was_measured_last_counts(v: Setup) -> None:
    """Not seen from 50 to 60 mm, and 0.8 mm aside from there on: the torch crosses it without a stop."""
    before, after = SeamLine(0.0, 0.0, 0.0), SeamLine(0.0, 0.8, 0.0)
    seen = [
        *walk(v, 9, before, step_mm=2.0, start_mm=-2.0),
        *walk(v, 24, after, step_mm=2.0, start_mm=25.0),
    ]
    tracker = Tracker(v, correction=STOP)
    found = [tracker.step(frame, pose) for frame, pose in seen]
    assert not any("follow_stopped" in track.flag_names for track in found)
    # Back at the start, and once more along a part that lies elsewhere.
    again = [tracker.step(frame, pose) for frame, pose in walk(v, 20, after, step_mm=2.0, start_mm=-2.0)]
    assert again[-1].offset_y_mm == pytest.approx(0.8, abs=0.05)


def test_jumps_to_different_places_are_no_seam(v: Setup) -> None:
    tracker = Tracker(v)
    for frame, pose in walk(v, 4):
        assert tracker.step(frame, pose).valid
    for n, y_mm in enumerate((1.4, -1.2, 1.5, -1.3, 1.2)):
        pose = pose_at(32.0 + n)
        track = tracker.step(frame_of(v, pose, SeamLine(0.0, y_mm, 0.0), index=4 + n), pose)
        assert not track.valid
    pose = pose_at(38.0)
    assert tracker.step(frame_of(v, pose, SeamLine(), index=9), pose).valid


def test_the_same_seam_twice_is_the_same_offset(v: Setup) -> None:
    """A correction replaces the one before: neither gain nor bias is summed."""
    correction = Correction(y=AxisCorrection(gain=0.5, bias_mm=0.5), z=AxisCorrection(enable=False))
    pose = pose_at(0.0)
    frame = frame_of(v, pose, SEAM)
    found = tracks(v, correction, iter([(frame, pose)] * 4))
    plain = tracks(v, Correction(), iter([(frame, pose)] * 4))
    offsets = np.array([track.offset_y_mm for track in found])
    np.testing.assert_allclose(offsets, offsets[0], atol=1e-3)
    np.testing.assert_allclose(offsets, 0.5 * np.array([track.offset_y_mm for track in plain]) + 0.5)
    assert all(math.isnan(track.offset_z_mm) and math.isnan(track.offset_sigma_z_mm) for track in found)
    assert found[0].offset_confidence > plain[0].offset_confidence


def test_the_nominal_lines_ends(v: Setup) -> None:
    """The torch is given the start's offset before the joint and none past it; the sensor measures on."""
    short = replace(v, joint=replace(v.joint, seam_in_base_mm=((20.0, 0.0, 0.0), (60.0, 0.0, 0.0))))
    found = tracks(short, Correction(), walk(short, 8, SEAM, step_mm=10.0))
    assert all(track.valid for track in found)
    named = [{"before_joint", "past_joint"} & set(track.flag_names) for track in found]
    assert named == [{"before_joint"}] * 2 + [set()] * 5 + [{"past_joint"}]
    assert [math.isnan(track.offset_y_mm) for track in found] == [False] * 7 + [True]
    plain = tracks(v, Correction(), walk(v, 8, SEAM, step_mm=10.0))
    assert found[3].offset_y_mm == pytest.approx(plain[3].offset_y_mm, abs=1e-9)


@pytest.mark.slow
def test_a_start_that_the_sensor_sees(v: Setup) -> None:
    """A plate without a joint up to 47 mm, the nominal start at 40 mm."""
    joint = replace(v.joint, seam_in_base_mm=((40.0, 0.0, 0.0), (1000.0, 0.0, 0.0)))
    setup = replace(v, joint=joint)
    plate = replace(setup, joint=replace(joint, type="flat", dimensions={}))
    poses = [pose_at(2.0 * n - 5.0) for n in range(18)]
    seen = [
        (frame_of(setup, pose, SEAM, index=n, of=setup if 2.0 * n - 5.0 + LASER_X_MM > 47.0 else plate), pose)
        for n, pose in enumerate(poses)
    ]
    found = tracks(setup, Correction(ends_mm=12.0), iter(seen))
    where, sigma = found[-1].joint_start_mm
    assert abs(where - 47.0) < 1.0 + 2.0 * sigma
    assert 0.3 < sigma < 1.5
    assert all("before_joint" in track.flag_names for track in found)
    assert math.isnan(found[9].joint_start_mm[0])
    assert all(math.isnan(value) for value in found[-1].joint_end_mm)
    at_start = 1.0 + 0.01 * where
    assert found[-1].offset_y_mm == pytest.approx(at_start, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("corrugation", ["in_path", "followed"])
def test_a_corrugation_is_followed_in_height(corrugation: str) -> None:
    """The displacement alone where the path goes over it; the sheet's own height too where it is flat."""
    setup = small_setup("corrugation")
    seam = SeamLine(0.0, 0.4, -0.3)
    size = setup.joint.dimensions

    def crest_mm(x_mm: float) -> float:
        u = abs((x_mm + size["pitch_mm"] / 2.0) % size["pitch_mm"] - size["pitch_mm"] / 2.0)
        inside = u < size["width_mm"] / 2.0
        return size["height_mm"] * math.cos(math.pi * u / size["width_mm"]) ** 2 if inside else 0.0

    stations = np.arange(-60.0, 20.0, 7.5)
    poses = [pose_at(x, 0.0, 1.0 + crest_mm(x)) for x in stations]
    seen = [(frame_of(setup, pose, seam, index=n), pose) for n, pose in enumerate(poses)]
    correction = Correction(corrugation="followed") if corrugation == "followed" else Correction()
    found = tracks(setup, correction, iter(seen))
    heights = []
    for track, x_mm in zip(found, stations, strict=True):
        if x_mm < stations[0] + LASER_X_MM:
            continue
        expected = -0.3 + (crest_mm(x_mm) if corrugation == "followed" else 0.0)
        assert track.offset_z_mm == pytest.approx(expected, abs=0.1), (x_mm, track.flag_names)
        heights.append(crest_mm(x_mm))
    assert min(heights) < 0.5
    assert max(heights) > 0.9 * size["height_mm"]


def test_a_frame_without_the_laser_says_nothing_of_the_joints_ends(v: Setup) -> None:
    short = replace(v, joint=replace(v.joint, seam_in_base_mm=((30.0, 0.0, 0.0), (900.0, 0.0, 0.0))))
    tracker = Tracker(short, correction=Correction(ends_mm=20.0))
    for n, laser in enumerate((1.0, 0.0, 1.0)):
        before = tracker.state.steering.ends
        pose = pose_at(2.0 * n)
        tracker.step(frame_of(short, pose, laser=laser, index=n), pose)
        is_same = np.array_equal(tracker.state.steering.ends, before, equal_nan=True)
        assert is_same == (laser == 0.0)


@pytest.mark.slow
def test_a_seam_out_of_view_says_nothing_of_the_joints_end(v: Setup) -> None:
    nominal = replace(v.joint, seam_in_base_mm=((-100.0, 0.0, 0.0), (120.0, 0.0, 0.0)))
    setup = replace(v, joint=nominal)
    tracker = Tracker(setup, correction=Correction(ends_mm=30.0))
    found = []
    for n in range(40):
        # The tool stands aside for 16 mm, shortly before where the joint may end; it goes on beyond.
        pose = pose_at(20.0 + 2.0 * n, 21.0 if 30 <= n < 38 else 0.0)
        found.append(tracker.step(frame_of(setup, pose, SeamLine(0.0, 0.3, 0.0), index=n), pose))
    assert any("seam_out_of_view" in track.flag_names for track in found[30:38])
    assert found[-1].valid
    assert math.isnan(found[-1].joint_end_mm[0])


def test_past_a_bend_the_torch_stands_where_its_own_segment_says(v: Setup) -> None:
    """The sensor is past a bend of 20 deg, the torch 34 mm before it on the first segment."""
    bend = math.radians(20.0)
    line = ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (100.0 + 200.0 * math.cos(bend), 200.0 * math.sin(bend), 0.0))
    setup = replace(v, joint=replace(v.joint, seam_in_base_mm=line))
    tracker = Tracker(setup)
    # The seam that is followed lies 1 mm to the left at 66 mm and drifts by a tenth of the way.
    for station in np.arange(50.0, 110.0, 2.0):
        history = tracker.state.history.with_measurement(
            float(station), np.array([0.1 * (station - 56.0), 0.0]), np.full(2, 1e-6)
        )
        tracker.state = tracker.state._replace(history=history)
    pose = pose_at(66.0)
    track = tracker.step(replace(frame_of(setup, pose), laser_on=False), pose)
    assert track.offset_y_mm == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_a_lead_asks_for_the_seam_farther_on(v: Setup) -> None:
    seen = list(walk(v, 12, SEAM, 8.0))
    plain, ahead = Tracker(v), Tracker(v)
    lead = OffsetLookAhead(0.2, 8.0)
    here = [plain.step(frame, pose) for frame, pose in seen]
    there = [ahead.step(frame, pose, lead) for frame, pose in seen]
    # A lead of one frame's way: the offset of the next frame, but for what that one measures in addition.
    for n in range(7, 11):
        assert there[n].offset_y_mm == pytest.approx(here[n + 1].offset_y_mm, abs=0.01)
        assert there[n].valid_at_s == pytest.approx(there[n].timestamp_s + 0.2)
        # What is measured is not moved by it.
        assert there[n].seam_tool_mm == here[n].seam_tool_mm
    assert there[9].offset_y_mm - here[9].offset_y_mm == pytest.approx(0.08, abs=0.02)
