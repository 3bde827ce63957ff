"""The process that answers FIND: it finds what is found here, and once it is killed another one answers."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from arctrack.live.serve.find_process import FindClient, frames_ring
from arctrack.live.serve.supervisor import SupervisedProcess
from arctrack.recording import read_recording
from tracker.find import Finder, FoundJoint, find_joint
from tracker.geometry import SensorGeometry


@pytest.mark.slow
def test_a_process_finds_the_joint_of_its_frames_and_so_does_the_one_after_it() -> None:
    recording = read_recording("examples/v_groove")
    shown = list(recording.posed(recording.readable_frames()[0]))[2:7]
    expected = find_joint(Finder(SensorGeometry.of(recording.setup)), shown)
    run = f"test-{os.getpid()}"
    with frames_ring(run, recording.setup) as ring:
        client = FindClient(run, ring)
        process = client.started({1: recording.setup})
        try:
            client.let_warm_up()
            process.wait_ready()
            # A request that is withdrawn: its answer is dropped.
            client.begin()
            client.keep(shown[0][0], shown[0][1].T_base_tool)
            assert client.found(1) is None
            client.begin()
            for frame, pose in shown:
                client.keep(frame, pose.T_base_tool)
            check_same(awaited(client, process), expected)

            client.begin()
            for frame, pose in shown:
                client.keep(frame, pose.T_base_tool)
            os.kill(process.state.pid, signal.SIGKILL)
            check_same(awaited(client, process), expected)
            assert process.state.ends == 1
        finally:
            process.end()


def awaited(client: FindClient, process: SupervisedProcess) -> FoundJoint:
    """Ask as a loop does until there is an answer, while the process is watched over."""
    until_s = time.monotonic() + 100.0
    while (joint := client.found(1)) is None:
        assert time.monotonic() < until_s, process.state
        time.sleep(0.01)
        process.look()
    return joint


def check_same(joint: FoundJoint, expected: FoundJoint) -> None:
    assert joint.refusal == expected.refusal == ""
    assert joint.point_base_mm.tolist() == expected.point_base_mm.tolist()
    assert np.array_equal(joint.R_base_found, expected.R_base_found)
    assert joint.track.gap_mm == expected.track.gap_mm
