from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time
from itertools import pairwise

import numpy as np
import pytest

from arctrack.live.cameras.shared_frames import (
    FIELDS,
    SharedFramesError,
    SharedFramesReader,
    SharedFramesWriter,
    path_of,
)
from arctrack.live.journal import private_memory
from arctrack.live.journal.ring import PAGE_BYTES, SLOT
from tracker.state import Frame


@pytest.fixture
def name(tmp_path, monkeypatch):
    monkeypatch.setattr(private_memory, "MEMORY", tmp_path)
    return "camera"


def frame(index, value=None, shape=(6, 8), dtype=np.uint8):
    image = np.full(shape, index % 200 if value is None else value, dtype)
    return Frame(index, 0.5 * index, image, 0.005, 100.0, laser_on=True, arc_on=index % 2 == 0)


def test_the_newest_frame_is_read_once_and_those_before_it_are_missed(name):
    with SharedFramesWriter(name, 6, 8) as writer, SharedFramesReader(name) as reader:
        assert reader.newest() is None
        writer.publish(frame(7))
        read = reader.newest()
        assert (read.index, read.timestamp_s, read.exposure_s, read.current_a) == (7, 3.5, 0.005, 100.0)
        assert (read.laser_on, read.arc_on) == (True, False)
        np.testing.assert_array_equal(read.image_dn, frame(7).image_dn)
        assert reader.newest() is None
        for index in range(8, 19):
            writer.publish(frame(index))
        # A frame that was read is a copy: the ring goes on over it.
        assert (read.image_dn == 7).all()
        assert reader.newest().index == 18
        assert reader.missed == 10
        with pytest.raises(ValueError, match="frame 1: is"):
            writer.publish(frame(1, shape=(8, 6)))
        with pytest.raises(ValueError, match="frame 1: is"):
            writer.publish(frame(1, dtype=np.uint16))


def test_a_number_that_is_skipped_is_a_frame_that_was_lost(name):
    with SharedFramesWriter(name, 6, 8) as writer, SharedFramesReader(name) as reader:
        for index in (40, 41, 44, 45):
            writer.publish(frame(index))
            reader.newest()
        assert reader.missed == 2
        # Its numbers begin anew.
        for index in (3, 4):
            writer.publish(frame(index))
        assert (reader.newest().index, reader.missed) == (4, 3)


def test_who_comes_late_sees_what_comes_from_then_on(name):
    with SharedFramesWriter(name, 6, 8, np.uint16) as writer:
        writer.publish(frame(1, dtype=np.uint16))
        with SharedFramesReader(name) as reader:
            assert reader.newest() is None
            writer.publish(frame(2, 40_000, dtype=np.uint16))
            assert reader.newest().image_dn.max() == 40_000
            assert reader.missed == 0


def test_a_frame_that_is_not_whole_is_not_read(name):
    with SharedFramesWriter(name, 6, 8) as writer, SharedFramesReader(name) as reader:
        writer.publish(frame(1))
        memory, at_byte = writer._ring._memory, PAGE_BYTES
        whole = bytes(memory[at_byte : at_byte + 8])
        # It is being written: its sequence is odd.
        memory[at_byte : at_byte + 8] = (1).to_bytes(8, "little")
        assert reader.newest() is None
        # It was written over since.
        memory[at_byte : at_byte + 8] = (4).to_bytes(8, "little")
        assert reader.newest() is None
        memory[at_byte : at_byte + 8] = whole
        # A pixel of another frame.
        pixel = at_byte + SLOT.size + FIELDS.size + 5
        memory[pixel] ^= 1
        assert reader.newest() is None
        memory[pixel] ^= 1
        assert reader.newest().index == 1


def test_one_writer_at_a_time_and_none_is_said(name):
    with pytest.raises(SharedFramesError, match="nobody publishes"):
        SharedFramesReader(name)
    with SharedFramesWriter(name, 6, 8), pytest.raises(SharedFramesError, match="another process publishes"):
        SharedFramesWriter(name, 6, 8)
    assert not path_of(name).exists()
    with SharedFramesWriter(name, 4, 4):
        pass


WRITER = """
    import sys, time
    from pathlib import Path
    import numpy as np
    from arctrack.live.cameras.shared_frames import SharedFramesWriter
    from arctrack.live.journal import private_memory
    from tracker.state import Frame
    private_memory.MEMORY = Path(sys.argv[1])
    writer = SharedFramesWriter("camera", 240, 320)
    for index in range(10**9):
        image = np.full((240, 320), index % 251, np.uint8)
        writer.publish(Frame(index, time.monotonic(), image, 0.005, float(index)))
        if index % 50 == 0:
            time.sleep(0.001)
"""


@pytest.mark.slow
def test_frames_of_another_process_are_whole_and_its_death_is_seen(name, tmp_path):
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(WRITER), str(tmp_path)])
    try:
        reader, until_s = None, time.monotonic() + 60.0
        while reader is None and time.monotonic() < until_s:
            try:
                reader = SharedFramesReader(name)
            except SharedFramesError:
                time.sleep(0.02)
        indices = []
        while len(indices) < 200 and time.monotonic() < until_s:
            read = reader.newest()
            if read is None:
                continue
            assert (read.image_dn == read.index % 251).all()
            assert read.current_a == read.index
            indices.append(read.index)
        assert len(indices) == 200
        assert all(later > sooner for sooner, later in pairwise(indices))
        # Every frame is read or missed, but for those before the first look.
        assert reader.missed >= indices[-1] - indices[0] + 1 - len(indices)
        assert reader.is_writer_alive
        process.send_signal(signal.SIGKILL)
        process.wait(10.0)
        assert not reader.is_writer_alive
        reader.close()
        # It left its file. Who looks for frames takes it away, and another writer may begin.
        assert path_of(name).exists()
        with pytest.raises(SharedFramesError, match="is dead"):
            SharedFramesReader(name)
        assert not path_of(name).exists()
        with SharedFramesWriter(name, 6, 8):
            assert path_of(name).exists()
    finally:
        process.kill()
        process.wait(10.0)
