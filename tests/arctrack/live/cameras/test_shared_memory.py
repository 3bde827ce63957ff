"""Frames of another process as a camera, and the laser that it switches there."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from made import small_setup

from arctrack.live.cameras import camera_line, shared_memory
from arctrack.live.cameras.camera import UnreadableFrame
from arctrack.live.cameras.camera_line import PULSE_HOLD_S, line_path, read_line, remove_line
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesWriter
from arctrack.live.cameras.shared_memory import SharedMemoryCamera
from arctrack.live.journal import private_memory
from robot_io import LaserState, RobotPulse
from tracker.state import Frame


@pytest.fixture
def name(tmp_path, monkeypatch):
    monkeypatch.setattr(private_memory, "MEMORY", tmp_path)
    return "camera"


def is_lit(name):
    return time.monotonic() < read_line(name).laser_until_s


def published(writer, setup, index):
    size = (setup.camera.height, setup.camera.width)
    writer.publish(Frame(index, 0.1 * index, np.full(size, index, setup.sensor.dtype), 0.005))


def writer_of(name, setup):
    return SharedFramesWriter(name, setup.camera.height, setup.camera.width, setup.sensor.dtype)


def test_frames_count_from_the_beginning_on_and_another_writer_is_found(name, monkeypatch):
    monkeypatch.setattr(shared_memory, "LOOK_AGAIN_S", -1.0)
    setup = small_setup()
    with pytest.raises(SharedFramesError, match="nobody publishes"):
        SharedMemoryCamera(name, setup)
    with writer_of(name, setup) as writer:
        camera = SharedMemoryCamera(name, setup)
        for index in range(3):
            published(writer, setup, index)
        camera.begin()
        assert (camera.newest(), camera.dropped) == (None, 0)
        for index in range(3, 6):
            published(writer, setup, index)
        assert (camera.newest().index, camera.dropped) == (5, 2)
    for _ in range(2):
        assert camera.newest() is None
    assert camera.dropped == 2
    with writer_of(name, setup) as writer:
        remove_line(name)
        assert camera.newest() is None
        published(writer, setup, 9)
        assert (camera.newest().index, camera.dropped) == (9, 2)
        # The line is its own again.
        camera.switch_laser(True)
        assert is_lit(name)
    camera.close()


def test_frames_of_another_size_are_refused(name):
    setup = small_setup()
    other = replace(setup, camera=replace(setup.camera, width=setup.camera.width - 1))
    with writer_of(name, other), pytest.raises(SharedFramesError, match="frames 'camera': each is "):
        SharedMemoryCamera(name, setup)


def test_frames_that_become_another_size_cannot_be_read(name, monkeypatch):
    monkeypatch.setattr(shared_memory, "LOOK_AGAIN_S", -1.0)
    setup = small_setup()
    other = replace(setup, camera=replace(setup.camera, width=setup.camera.width - 1))
    with writer_of(name, setup):
        camera = SharedMemoryCamera(name, setup)
    camera.newest()
    with writer_of(name, other) as writer:
        camera.newest()
        published(writer, other, 4)
        frame = camera.newest()
        assert isinstance(frame, UnreadableFrame)
        assert (frame.index, frame.timestamp_s) == (4, 0.4)
    camera.close()


def test_the_laser_goes_off_by_itself_unless_it_is_kept_on(name, monkeypatch):
    setup = small_setup()
    # Nobody drives it: it is wired to be on.
    assert is_lit(name)
    with writer_of(name, setup):
        camera = SharedMemoryCamera(name, setup)
        assert not is_lit(name)
        assert camera.switch_laser(True) is LaserState.ON
        assert is_lit(name)
        assert camera.switch_laser(False) is LaserState.OFF
        assert not is_lit(name)
        monkeypatch.setattr(camera_line, "HOLD_S", 0.0)
        camera.switch_laser(True)
        assert not is_lit(name)
        camera.close()
    assert not is_lit(name)
    line_path(name).write_bytes(b"")
    assert not is_lit(name)
    remove_line(name)
    assert is_lit(name)


def test_a_line_that_is_written_meanwhile_leaves_the_laser_off(name):
    with writer_of(name, small_setup()):
        camera = SharedMemoryCamera(name, small_setup())
        camera.switch_laser(True)
        whole = line_path(name).read_bytes()
        line_path(name).write_bytes(whole[:8] + b"?" + whole[9:])
        assert not is_lit(name)
        line_path(name).write_bytes(whole)
        assert is_lit(name)
        camera.close()
    remove_line(name)


def test_the_arcs_pulse_is_told_until_it_is_too_old_or_there_is_none(name):
    with writer_of(name, small_setup()):
        camera = SharedMemoryCamera(name, small_setup())
        camera.switch_laser(True)
        camera.tell_pulse(RobotPulse(20_000, 12_000, 3.0), 50.0)
        wanted = read_line(name)
        assert (wanted.base_begin_s, wanted.period_s, wanted.base_s) == pytest.approx((49.997, 0.02, 0.012))
        assert wanted.pulse_until_s == 50.0 + PULSE_HOLD_S
        for unknown in (RobotPulse(None, 12_000, 3.0), RobotPulse(20_000, None, 3.0), RobotPulse(0, 0, 3.0)):
            camera.tell_pulse(RobotPulse(20_000, 12_000, 3.0), 50.0)
            camera.tell_pulse(unknown, 51.0)
            assert read_line(name).pulse_until_s == 0.0
        # The laser is as it was.
        assert is_lit(name)
        camera.close()
    remove_line(name)
