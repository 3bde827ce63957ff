"""A profiler's stream over TCP: whole profiles on the host's clock, and refusals of all else."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made import small_setup
from profiler_setup import profiler_setup

from arctrack.control.cell_file import CameraChoice
from arctrack.errors import ArctrackError
from arctrack.live.cameras.capture.profile_stream import SILENT_S, ProfileStream
from arctrack.live.cameras.profile_message import (
    ProfileMessageError,
    pack_profile,
    take_profile,
)
from arctrack.live.serve.captured_camera import CapturedCamera
from arctrack.recording import read_setup_file
from noise_model.instrument.profiler import Profiler
from noise_model.setup import Setup
from tracker.state import Frame

PEER = Path(__file__).with_name("profiler_peer.py")
COLUMNS = 64
PATIENCE_S = 60.0


@contextmanager
def peer(*acts: str, columns: int = COLUMNS) -> Iterator[str]:
    """Run a profiler's program in a process of its own; yield its HOST:PORT."""
    command = [sys.executable, str(PEER), str(columns), *acts]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield f"127.0.0.1:{process.stdout.readline().strip()}"
        finally:
            process.kill()


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    (tmp_path / "recording.toml").write_text(profiler_setup(COLUMNS, 0.5))
    return read_setup_file(tmp_path / "recording.toml").setup


@pytest.fixture
def profiler(setup: Setup) -> Profiler:
    assert setup.profiler is not None
    return setup.profiler


def frames_until_failure(stream: ProfileStream) -> tuple[list[Frame], str]:
    """Return the frames of a stream up to the error that ends it, and the error."""
    frames, until_s = [], time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        try:
            frame = stream.read()
        except ArctrackError as error:
            return frames, str(error)
        if frame is not None:
            frames.append(frame)
    raise AssertionError("the stream never failed")


@given(
    st.integers(0, 2**63),
    st.lists(st.tuples(st.floats(width=32, allow_infinity=False), st.integers(0, 65535)), max_size=20),
    st.integers(0, 300),
    st.booleans(),
)
def test_a_profile_comes_out_as_it_went_in_however_it_is_cut(
    number: int, points: list[tuple[float, int]], cut: int, has_sigmas: bool
) -> None:
    z_mm, intensity = np.array([z for z, _ in points]), np.array([i for _, i in points], np.uint16)
    sigma_mm = 0.5 * z_mm if has_sigmas and len(points) else None
    sent = pack_profile(number, -7, z_mm, intensity, sigma_mm) + b"ATP"
    received = bytearray(sent[:cut])
    first = take_profile(received, len(points))
    received += sent[cut:]
    profile = take_profile(received, len(points)) if first is None else first
    assert profile is not None
    assert (profile.number, profile.time_ns, bytes(received)) == (number, -7, b"ATP")
    np.testing.assert_array_equal(profile.z_mm, z_mm)
    np.testing.assert_array_equal(profile.intensity, intensity)
    if sigma_mm is None:
        assert profile.sigma_mm is None
    else:
        np.testing.assert_array_equal(profile.sigma_mm, sigma_mm.astype(np.float32))


def test_bytes_that_are_no_profile_are_refused_at_once() -> None:
    sent = pack_profile(1, 0, np.zeros(5), np.zeros(5, np.uint16))
    with pytest.raises(ProfileMessageError, match=r"gives 5 columns, .* states columns = 4"):
        take_profile(bytearray(sent[:32]), 4)
    with pytest.raises(ProfileMessageError, match="gives no profile"):
        take_profile(bytearray(b"A?"), 5)
    with pytest.raises(ValueError, match="heights"):
        pack_profile(1, 0, np.zeros(4), np.zeros(5, np.uint16))
    with pytest.raises(ValueError, match="within 0 to 65535"):
        pack_profile(1, 0, np.zeros(2), np.array([0, 65_536]))
    with pytest.raises(ValueError, match="sigmas"):
        pack_profile(1, 0, np.zeros(4), np.zeros(4, np.uint16), np.zeros(5))


def test_profiles_come_whole_and_on_the_hosts_clock(profiler: Profiler) -> None:
    with peer("breaks:5") as name:
        stream = ProfileStream(name, profiler)
        stream.begin()
        began_s = time.monotonic()
        frames, problem = frames_until_failure(stream)
    assert "closed the connection" in problem
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    for n, frame in enumerate(frames):
        z_mm = n + 0.001 * np.arange(COLUMNS)
        z_mm[3] = np.nan
        np.testing.assert_allclose(profiler.z_mm(frame.image_dn[0]), z_mm, atol=profiler.step_mm)
        assert (frame.image_dn[1] == n).all()
        assert frame.image_dn.dtype == np.uint16
        assert began_s - 0.5 < frame.timestamp_s < time.monotonic()
    assert (np.diff([frame.timestamp_s for frame in frames]) > 0.0).all()


def test_sigmas_of_points_are_in_the_frame(profiler: Profiler) -> None:
    measured = replace(profiler, point_sigma=True)
    with peer("has_sigmas:0") as name:
        stream = ProfileStream(name, measured)
        stream.begin()
        frame = None
        while frame is None:
            frame = stream.read()
        stream.close()
    sigma_mm = 0.001 * (1.0 + np.arange(COLUMNS))
    # Column 3 has no height.
    sigma_mm[3] = np.nan
    assert frame.image_dn.shape == (3, COLUMNS)
    np.testing.assert_allclose(measured.own_sigmas_mm(frame.image_dn), sigma_mm, atol=2e-5)


@pytest.mark.parametrize(
    ("act", "problem"),
    [
        ("has_sigmas:2", "gives sigmas: state [camera] point_sigma = true in the setup, or send none"),
        ("breaks:2", "the sensor's program closed the connection"),
        ("narrows:2", "gives 63 columns, the setup's [camera] states columns = 64"),
        ("babbles:2", "gives no profile: a message begins with b'HTTP/1.1'"),
        ("repeats:2", "gives number 1001 after 1001: numbers must rise"),
    ],
)
def test_what_is_wrong_with_a_stream_ends_it_by_name(profiler: Profiler, act: str, problem: str) -> None:
    with peer(act) as name:
        stream = ProfileStream(name, profiler)
        frames, said = frames_until_failure(stream)
    assert len(frames) == 2
    assert said == f"[camera] name = {name!r}: {problem}"


@pytest.mark.slow
@pytest.mark.parametrize("act", ["stalls:2", "drips:2"])
def test_a_stream_that_stalls_ends(profiler: Profiler, act: str) -> None:
    with peer(act) as name:
        stream = ProfileStream(name, profiler)
        stream.begin()
        began_s = time.monotonic()
        frames, said = frames_until_failure(stream)
        took_s = time.monotonic() - began_s
    assert len(frames) == 2
    assert "no whole profile came in 2 s" in said
    assert took_s >= SILENT_S


def test_lost_profiles_leave_a_gap_in_the_numbers(profiler: Profiler) -> None:
    with peer("skips:2") as name:
        stream, frames = ProfileStream(name, profiler), []
        while len(frames) < 3:
            frame = stream.read()
            frames += [] if frame is None else [frame]
        stream.close()
    assert [frame.index for frame in frames] == [0, 1, 4]


@pytest.mark.parametrize("name", ["192.168.0.10", ":5021", "sensor:0", "sensor:x", "sensor:99999"])
def test_a_name_that_is_no_address_is_refused(profiler: Profiler, name: str) -> None:
    with pytest.raises(ArctrackError, match="must be HOST:PORT"):
        ProfileStream(name, profiler)


def test_a_camera_that_cannot_be_opened_is_named_with_its_file(tmp_path: Path, setup: Setup) -> None:
    cell_path = tmp_path / "cell.toml"
    with socket.create_server(("127.0.0.1", 0)) as free:
        name = f"127.0.0.1:{free.getsockname()[1]}"
    for camera, its_setup, problem in (
        (CameraChoice(50.0, "profile_tcp", name), setup, r"name = '127.*cannot be reached \(.*\); start the"),
        (CameraChoice(50.0, "profile_tcp", name), small_setup(), "the setup's camera gives images; state"),
        (CameraChoice(50.0, "gige", "sensor"), setup, "the setup's camera is a profiler; state kind"),
    ):
        with pytest.raises(ArctrackError, match=rf"cell.toml: \[camera\] .*{problem}"):
            CapturedCamera(camera, cell_path, its_setup)


@pytest.mark.slow
def test_a_camera_goes_silent_with_its_stream_and_comes_back(tmp_path: Path, setup: Setup) -> None:
    # A connection that is looked at, one that stalls, two that do not fit, and a good one twice.
    with peer("breaks:1", "stalls:20", "narrows:0", "babbles:0", "breaks:1", "breaks:100000") as name:
        camera = CapturedCamera(CameraChoice(100.0, "profile_tcp", name), tmp_path / "cell.toml", setup)
        try:
            camera.begin()
            came: list[tuple[float, Frame]] = []
            problems: list[str] = []
            until_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < until_s and not (came and came[-1][1].index > 60):
                problems += camera.process.look()
                frame = camera.newest()
                if frame is not None:
                    assert isinstance(frame, Frame)
                    came.append((time.monotonic(), frame))
                time.sleep(0.002)
        finally:
            camera.close()
    ages_s = np.array([at_s - frame.timestamp_s for at_s, frame in came])
    # None is from the future, and none from before the stall. On a busy machine a frame may wait.
    assert (ages_s > 0.0).all()
    assert np.median(ages_s) < SILENT_S
    apart_s = np.diff([at_s for at_s, _ in came])
    assert (apart_s > SILENT_S).any()
    assert (np.diff([frame.index for _, frame in came]) > 0).all()
    said = "\n".join(problems)
    for problem in ("no whole profile came in 2 s", "gives 63 columns", "gives no profile", "works again"):
        assert problem in said
