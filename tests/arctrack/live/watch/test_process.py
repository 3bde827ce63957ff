"""The watch beside a live run: a window that gets dirty is told, named, and dated; a clean one is not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from arctrack.live.journal import private_memory
from arctrack.live.journal.journal import Journal, JournalReader
from arctrack.live.journal.records import Entry, FrameView
from arctrack.live.watch.process import RunWatch
from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from noise_model.setup import Setup
from robot_io import SeamOffset, Validity
from tracker.state import Frame, Pose
from tracker.step import StepInputs
from tracker.tracker import Tracker

pytestmark = pytest.mark.slow

RUN, RATE_HZ, DRAWN = "watched", 10.0, 12
DIRTY = {"dirty_window": {"dimming_1": 0.8, "u_1": -0.2, "v_1": 0.1, "radius_1": 0.3}}

OFFSET = SeamOffset(0.1, -0.2, 24.0, 0.9, Validity.VALID)


def drawn(setup: Setup, nominal: Setup, seed: int) -> list[tuple[Entry, FrameView]]:
    """Return frames along a seam, and what the tracker that knows the nominal setup makes of them."""
    rng, renderer, tracker = np.random.default_rng(seed), Renderer(), Tracker(nominal)
    made = []
    for n in range(DRAWN):
        T_base_tool = np.eye(4)
        T_base_tool[:3, 3] = 50.0 + 4.0 * n, 0.4 * math.sin(n), 1.0 + 0.3 * math.cos(n)
        image = draw_frame(setup, T_base_tool, Condition(1.0, 1.0, 0.005), rng, renderer=renderer)
        frame, pose = Frame(n, float(n), image, 0.005, nominal.arc.current_a), Pose(T_base_tool)
        inputs = StepInputs(tracker.state, pose)
        track = tracker.step(frame, pose)
        reading = tracker.reading
        assert reading is not None
        entry = Entry(frame, inputs, replace(track, stripe=None, checks=()), OFFSET, 1)
        shown = replace(track, checks=())
        made.append((entry, FrameView(0, shown, reading.seam, reading.reach_mm, reading.arc, reading.joint)))
    return made


def test_a_window_that_gets_dirty_is_told_and_named(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(private_memory, "MEMORY", tmp_path)
    nominal = balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))
    nominal = replace(nominal, camera=replace(nominal.camera, exposure_s=0.005))
    clean, dirty = drawn(nominal, nominal, 1), drawn(replace(nominal, effects=DIRTY), nominal, 2)
    camera = nominal.camera
    journal = Journal(RUN, (camera.height, camera.width), nominal.sensor.dtype, 400)
    watch = RunWatch(JournalReader(RUN), {1: nominal})
    began_s = 45.0
    reports = []
    for n in range(600):
        time_s = n / RATE_HZ
        entry, view = (clean if time_s < began_s else dirty)[n % DRAWN]
        frame = replace(entry.frame, index=n, timestamp_s=time_s)
        track = replace(entry.track, frame=n, timestamp_s=time_s)
        position = journal.write_entry(replace(entry, frame=frame, track=track))
        journal.write_view(replace(view, position=position))
        if n % 2 == 1:
            watch.look()
        if n in (400, 599):
            reports.append(watch.report())
    journal.close()
    before, after = reports
    assert not before.is_gap
    assert before.text == ""
    stated_mm = nominal.arc.center_in_tool_mm[2]
    assert before.arc_height_mm == pytest.approx(stated_mm, abs=3.0 * before.arc_height_sigma_mm)
    assert after.is_gap
    assert "looks like dirty window" in after.text
    assert watch.since_s == pytest.approx(began_s, abs=3.0)
