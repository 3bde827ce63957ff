"""A GigE Vision stream off Aravis' fake camera, another process, over real sockets on loopback."""

from __future__ import annotations

import fcntl
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from arctrack.control.cell_file import CameraChoice, CaptureChoice
from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import SLACK_S, CaptureRequest
from arctrack.live.cameras.capture.device_clock import WINDOW_S, DeviceClock
from arctrack.live.journal.private_memory import private_path
from arctrack.nominal import nominal_setup

pytestmark = pytest.mark.filterwarnings("ignore:DynamicImporter:ImportWarning")

WIDTH, ROWS, RATE_HZ = 512, 64, 50.0
FAKE = Path(__file__).with_name("fake_gige.py")


def test_the_least_delayed_stamp_gives_the_clocks_offset():
    rng = np.random.default_rng(2)
    clock, offset_s, period_s = DeviceClock(), 1234.5, 0.02
    errors_s = []
    for n in range(1000):
        stamp_s = period_s * n
        arrived_s = stamp_s + offset_s + rng.exponential(0.001)
        errors_s.append(clock.host_s(stamp_s, arrived_s) - stamp_s - offset_s)
    settled_s = np.array(errors_s[100:])
    kept = round(WINDOW_S / period_s)
    # n delays of mean m: the least one has mean and sigma m / n.
    assert clock.sigma_s == pytest.approx(0.001 / kept, rel=0.3)
    assert settled_s.min() >= 0.0
    assert settled_s.mean() < 5.0 * 0.001 / kept
    # A clock that was set back is followed once the window has passed.
    for n in range(1000, 1000 + kept + 2):
        host_s = clock.host_s(period_s * n - 7.0, period_s * n + offset_s)
    assert host_s == pytest.approx(period_s * (1000 + kept + 1) + offset_s, abs=0.001)


@pytest.mark.parametrize(
    ("before", "after", "step"),
    [(0, 7, 1), (7, 8, 1), (7, 10, 3), (65_534, 65_535, 1), (65_535, 1, 1), (65_533, 2, 4), (9, 8, -1),
     (1, 65_535, -1), (70_000, 140_000, 70_000), (65_405, 0, 0), (0, 0, 0)],
)  # fmt: skip
def test_ids_of_16_bits_go_round_without_0(before, after, step):
    from arctrack.live.cameras.capture.gige import frames_between

    assert frames_between(before, after) == step


class Wants:
    """What a test wants of a camera."""

    def __init__(self) -> None:
        self.wanted = CaptureRequest()

    def __call__(self) -> CaptureRequest:
        return self.wanted


@pytest.fixture
def fake(request):
    # The camera's port is the same for all: one test at a time has it, whichever worker runs it.
    with private_path("fake-gige.lock").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield from running_fake(request)


def running_fake(request):
    from arctrack.live.cameras.capture.genicam import aravis

    try:
        aravis()
    except ArctrackError as error:
        pytest.skip(str(error))
    lost_share = getattr(request, "param", 0.0)
    command = [sys.executable, str(FAKE), "arctrack", str(lost_share)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        said = process.stdout.readline()
        if said != "ready\n":
            process.kill()
            pytest.fail(f"the fake camera did not begin: {said}")
        yield lost_share
        process.stdin.close()
        process.wait(10.0)


def choice_of(**options) -> CameraChoice:
    return CameraChoice(RATE_HZ, "gige", "127.0.0.1", CaptureChoice(rows=(16, ROWS), **options))


def setup_of(bits: int = 8):
    setup = nominal_setup("v_groove", "mild_steel", width=WIDTH, height=ROWS)
    return replace(setup, sensor=replace(setup.sensor, bits=bits))


def opened(choice, wants, setup=None):
    from arctrack.live.cameras.capture.gige import GigeSource

    return GigeSource(choice, setup or setup_of(), wants)


def read_frames(source, enough):
    """Read until so many whole frames came; yield each as it comes."""
    while enough > 0:
        frame = source.read()
        if frame is not None:
            enough -= 1
            yield frame


@pytest.mark.slow
@pytest.mark.parametrize("fake", [0.0, 0.01], indirect=True)
def test_every_frame_is_whole_or_counted(fake):
    from arctrack.live.cameras.capture.gige import BUFFERS

    source = opened(choice_of(), Wants())
    source.begin()
    frames = [(frame, time.monotonic()) for frame in read_frames(source, 80)]
    counts = source.counts()
    source.close()
    indices = [frame.index for frame, _ in frames]
    assert all(later > sooner for sooner, later in pairwise(indices))
    taken, lost = indices[-1] + 1, indices[-1] + 1 - len(indices)
    # Aravis' thread is ahead of the reader by no more frames than it has buffers.
    not_whole = counts["n_failures"] + counts["n_missing_frames"] + counts["n_underruns"]
    assert lost <= not_whole <= lost + BUFFERS
    # A busy machine loses frames of a sound camera, too.
    assert lost < taken / 2
    if fake > 0.0:
        assert lost > 0
    # A frame of the fake camera is a ramp: one that is torn has a jump in it.
    for frame, _ in frames:
        assert frame.image_dn.shape == (ROWS, WIDTH)
        steps = np.diff(frame.image_dn.astype(int), axis=1) % 255
        assert len(np.unique(steps)) <= 3
    times_s = np.array([frame.timestamp_s for frame, _ in frames])
    late_s = np.array([arrived_s for _, arrived_s in frames]) - times_s
    assert (late_s > 0.0).all()
    apart_s = np.diff(times_s) / np.diff(indices)
    assert np.median(apart_s) == pytest.approx(1.0 / RATE_HZ, abs=0.0005)


@pytest.mark.slow
def test_exposure_laser_and_interleave_go_with_their_frames(fake):
    wants = Wants()
    options = {"trigger": "software", "laser_line": "Line1", "interleave": 4}
    source = opened(choice_of(**options), wants, setup_of(16))
    source.begin()
    first_s = source._exposure_s
    dark = list(read_frames(source, 10))
    assert not any(frame.laser_on for frame in dark)
    wants.wanted = CaptureRequest(laser_until_s=np.inf, exposure_s=2.0 * first_s)
    frames = []
    for frame in read_frames(source, 20):
        frames.append(frame)
        is_driven = source._camera.get_string("LineSource") == "ExposureActive"
        # A busy machine may lose a frame: what counts is the number of its trigger.
        assert frame.laser_on == is_driven == (source._triggered % 4 != 0)
    # The fake camera's light goes by the logarithm of the exposure: brighter frames are those marked so.
    assert {frame.exposure_s for frame in frames[1:]} == {2.0 * first_s}
    before, after = dark[-1].image_dn.mean(), frames[-1].image_dn.mean()
    assert after != pytest.approx(before, rel=0.01)
    wants.wanted = CaptureRequest()
    assert not any(frame.laser_on for frame in read_frames(source, 8))
    assert source._camera.get_string("LineSource") == "Off"
    source.close()


@pytest.mark.slow
def test_a_base_phase_that_the_robot_tells_is_met(fake):
    wants = Wants()
    source = opened(choice_of(trigger="software"), wants)
    source.begin()
    begin_s, period_s, base_s = time.monotonic(), 0.05, 0.02
    wants.wanted = CaptureRequest(0.0, np.nan, begin_s, period_s, base_s, np.inf)
    commanded_s = {source._triggered_s}
    while len(commanded_s) < 20:
        source.read()
        commanded_s.add(source._triggered_s)
    exposed_s = source._exposure_s
    source.close()
    # When the fake camera heeds a command it chooses itself, on a grid of 40 ms: what counts is the command.
    phases_s = (np.sort(list(commanded_s))[1:] - begin_s) % period_s
    # A busy machine sends commands late, none early.
    assert phases_s.min() == pytest.approx((base_s - exposed_s) / 2.0, abs=SLACK_S)


@pytest.mark.slow
def test_what_a_camera_cannot_do_names_the_key(fake):
    for choice, setup, message in (
        (choice_of(), setup_of(12), r"\[camera\] name: the camera has no Mono12; it has Mono16, Mono8"),
        (replace(choice_of(), name="nobody"), setup_of(), r"\[camera\] name = 'nobody': no such camera"),
        (choice_of(laser_line="Line7"), setup_of(), r"laser_line = 'Line7': .* it has Line1"),
        (choice_of(trigger="hardware", trigger_line="Line9"), setup_of(), r"trigger_line = 'Line9': "),
        (choice_of(), nominal_setup("lap", "mild_steel"), r"gives 512 x 64 px, the setup's \[camera\] says"),
    ):
        with pytest.raises(ArctrackError, match=message):
            opened(choice, Wants(), setup)
