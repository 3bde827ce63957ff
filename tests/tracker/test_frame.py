"""A frame that is tracked in one call against the same step by its pieces: the same numbers, bit for bit."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import pytest
from rendered import frame_of, pose_at, small_setup

from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker import flags
from tracker.checks import Asked
from tracker.frame import TRACKS
from tracker.frame_pieces import BY_PIECES, REFUSED, TRACKED, FrameGiven, FrameTracked
from tracker.geometry import SensorGeometry
from tracker.seam.correction import AxisCorrection, Correction
from tracker.seam.steer import AT_ONCE, Lead
from tracker.state import Frame, Pose, Track
from tracker.step import step_and_reading, step_by_step
from tracker.stripe.read import Work
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerState

SEAM = SeamLine(0.0, 0.6, -0.3, 0.01, 0.002)
CORRECTIONS = {
    "unstated": Correction(),
    "held": Correction(when_lost="hold", ends_mm=10.0, y=AxisCorrection(gain=0.8, limit_mm=0.5)),
    "stops": Correction(when_lost="stop", corrugation="followed", z=AxisCorrection(enable=False)),
}


def frames(setup: Setup) -> Iterator[tuple[Frame, Pose]]:
    """A walk along a seam during which much goes wrong, at last so long that it is searched anew."""
    rng = np.random.default_rng(0)
    for n in range(32):
        pose, light = pose_at(1.6 * n, 0.2 * np.sin(n)), {}
        seam = SEAM if n < 18 else SEAM._replace(y_mm=1.4)
        if n == 6:
            light = {"laser": 0.0}
        if n == 8:
            light = {"arc": 0.0}
        if n == 10:
            light = {"laser": 30.0}
        frame = frame_of(setup, pose, seam, index=n, **light)
        if n == 12 or 26 <= n < 30:
            frame = replace(frame, image_dn=rng.integers(0, 60, frame.image_dn.shape).astype(np.uint8))
        if n == 14:
            bright = np.where(rng.random(frame.image_dn.shape) < 0.02, 255, frame.image_dn)
            frame = replace(frame, image_dn=bright.astype(np.uint8))
        if n == 15:
            pose = replace(pose, extrapolated=True)
        if n == 16:
            frame = replace(frame, laser_on=False)
        yield frame, pose


def numbers(value: object) -> Iterator[object]:
    """All numbers and arrays of a track or a state, in their order."""
    if isinstance(value, Track):
        for field in fields(value):
            if field.name != "checks":
                yield from numbers(getattr(value, field.name))
        for check in value.checks:
            yield from (check.question.id, check.value, check.limit, check.flag.bit)
    elif isinstance(value, tuple):
        yield from (number for part in value for number in numbers(part))
    else:
        yield value


@pytest.mark.parametrize("correction", list(CORRECTIONS))
@pytest.mark.parametrize(
    "name", ["v_groove", "u_groove", "half_v", "fillet", "butt", "edge", "lap", "corrugation"]
)
def test_a_frame_in_one_call_is_the_step_by_its_pieces(
    monkeypatch: pytest.MonkeyPatch, name: str, correction: str
) -> None:
    setup = small_setup(name)
    # The look too by its pieces, as where effects act: here none change the light.
    by_pieces = SensorGeometry.of(setup)
    by_pieces.__dict__["has_light_effects"] = True
    monkeypatch.setattr("tracker.measure.transmission_of", lambda *_: None)
    geometry, follow = SensorGeometry.of(setup), CORRECTIONS[correction]
    state, works, in_one_call = TrackerState(), (Work.of(geometry), Work.of(geometry)), 0
    raised = searched = 0
    for n, (frame, pose) in enumerate(frames(setup)):
        lead = AT_ONCE if n % 2 else Lead(0.02, 0.4)
        given = geometry, state, frame, pose
        after, track, reading = step_and_reading(*given, works[0], True, follow, lead)
        twin, twins_track, twins_reading = step_by_step(by_pieces, *given[1:], works[1], True, follow, lead)
        for told, want in zip(numbers((track, after)), numbers((twins_track, twin)), strict=True):
            np.testing.assert_array_equal(told, want)
        assert (reading is None) == (twins_reading is None)
        if reading is not None and twins_reading is not None:
            assert (reading.joint is None) == (twins_reading.joint is None)
        in_one_call += reading is not None and reading.reach_mm < 5.0
        searched += bool(track.flags & flags.SEARCHED.mask)
        raised |= track.flags
        state = after
    assert in_one_call > 12
    assert searched > 2
    for flag in (flags.LASER_OFF, flags.ARC_OFF, flags.STRIPE_LOST, flags.POSE_EXTRAPOLATED, flags.SATURATED):
        assert raised & flag.mask, flag.name


def test_what_one_call_cannot_track_is_handed_back() -> None:
    """A butt whose gap the stripe does not tell, and a pose from which no seam is seen."""
    seen: list[int] = []

    def ends(setup: Setup, frame: Frame, pose: Pose) -> tuple[int, Track]:
        called = TRACKS[setup.joint.type]

        def heard(*args: object) -> FrameTracked:
            tracked: FrameTracked = called(*args)  # type: ignore[arg-type]
            seen.append(tracked.ends)
            return tracked

        geometry = SensorGeometry.of(setup)
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(TRACKS, setup.joint.type, heard)  # type: ignore[arg-type]
            _, track, _ = step_and_reading(geometry, TrackerState(), frame, pose, Work.of(geometry))
        return seen[-1], track

    groove, butt, pose = small_setup("v_groove"), small_setup("butt"), pose_at(0.0)
    assert ends(groove, frame_of(groove, pose, SEAM), pose)[0] == TRACKED
    joint = replace(butt.joint, dimensions={**butt.joint.dimensions, "gap_mm": 0.0})
    closed = replace(butt, joint=joint)
    assert ends(closed, frame_of(closed, pose, SEAM), pose)[0] == BY_PIECES
    far = replace(pose, T_base_tool=pose.T_base_tool @ np.diag([1.0, -1.0, -1.0, 1.0]))
    end, refused = ends(groove, frame_of(groove, pose, SEAM), far)
    assert end == REFUSED
    assert refused.flags & flags.INVALIDATING


def test_a_prepared_call_asks_for_types_where_they_may_be_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its tracks are those of a call that always asks."""
    setup, asked = small_setup("v_groove"), []
    called = TRACKS["v_groove"]

    def heard(told: Asked, given: FrameGiven) -> FrameTracked:
        asked.append(given)
        return called(told, given._replace(state=given.state._replace(lost=int(given.state.lost))))

    plain, prepared = Tracker(setup), Tracker(setup)
    prepared.warm_up()
    call = prepared._call
    assert call is not None
    monkeypatch.setattr(call, "_call", heard)
    for n, (frame, pose) in enumerate(itertools.islice(frames(setup), 6)):
        if n == 3:
            # As a host would that keeps states: equal, but another object.
            prepared.state = prepared.state._replace(frames=prepared.state.frames)
        if n == 4:
            # Equal, but of another type.
            prepared.state = prepared.state._replace(lost=float(prepared.state.lost))  # type: ignore[arg-type]
        pairs = zip(numbers(plain.step(frame, pose)), numbers(prepared.step(frame, pose)), strict=True)
        for told, want in pairs:
            np.testing.assert_array_equal(told, want)
        assert len(asked) == (n >= 4)
