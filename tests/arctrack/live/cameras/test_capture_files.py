"""Videos, folders and devices as cameras: every frame, in order, through the process that captures."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made import noise_frames, small_setup

from arctrack.control.cell_file import CameraChoice, CaptureChoice
from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import SLACK_S, CaptureRequest, is_reached, trigger_at_s
from arctrack.live.cameras.capture.device import DeviceSource
from arctrack.live.cameras.capture.files import LumaVideo, folder_source, video_source
from arctrack.live.serve.captured_camera import CapturedCamera
from arctrack.recording.ffv1 import VideoWriter

RATE_HZ = 200.0
PATIENCE_S = 120.0
HEAD = "frame,timestamp_s,laser_on,arc_on,current_a,exposure_s\n"


def written(path, frames, setup):
    camera = setup.camera
    with VideoWriter(path, camera.width, camera.height, setup.sensor.dtype, RATE_HZ) as video:
        for frame in frames:
            video.write(frame.image_dn, frame.timestamp_s)
    return path


def all_of(source):
    source.begin()
    frames, until_s = [], time.monotonic() + PATIENCE_S
    while not source.is_over and time.monotonic() < until_s:
        frame = source.read()
        if frame is not None:
            frames.append(frame)
    return frames


@pytest.mark.parametrize("bits", [8, 12])
def test_frames_of_a_video_are_those_of_the_file_in_order(tmp_path, bits):
    setup = small_setup(bits)
    given_frames = noise_frames(setup, 7)
    path = written(tmp_path / "weld.mkv", given_frames, setup)
    frames = all_of(video_source(path, setup, False, CaptureRequest))
    assert [frame.index for frame in frames] == list(range(7))
    for frame, before in zip(frames, given_frames, strict=True):
        np.testing.assert_array_equal(frame.image_dn, before.image_dn)
        assert (frame.exposure_s, frame.laser_on) == (setup.camera.exposure_s, True)
    apart_s = np.diff([frame.timestamp_s for frame in frames])
    np.testing.assert_allclose(apart_s, 1.0 / RATE_HZ, atol=1e-9)


def test_a_table_beside_a_video_states_its_times_and_what_was_lost(tmp_path):
    setup = small_setup()
    path = written(tmp_path / "weld.mkv", noise_frames(setup, 3), setup)
    (tmp_path / "weld.csv").write_text(HEAD + "4,9.1,1,1,100,0.002\n5,9.12,0,1,90,0.002\n8,9.15,1,0,,0.001\n")
    frames = all_of(video_source(path, setup, False, CaptureRequest))
    assert [frame.index for frame in frames] == [0, 1, 4]
    assert [(frame.laser_on, frame.arc_on) for frame in frames] == [
        (True, True),
        (False, True),
        (True, False),
    ]
    assert [frame.exposure_s for frame in frames] == [0.002, 0.002, 0.001]
    np.testing.assert_allclose(np.diff([frame.timestamp_s for frame in frames]), [0.02, 0.03], atol=1e-9)


def test_a_video_that_loops_goes_on_in_numbers_and_times(tmp_path):
    setup = small_setup()
    path = written(tmp_path / "weld.mkv", noise_frames(setup, 3), setup)
    source = video_source(path, setup, True, CaptureRequest)
    source.begin()
    frames = []
    while len(frames) < 8:
        frame = source.read()
        if frame is not None:
            frames.append(frame)
    assert [frame.index for frame in frames] == list(range(8))
    np.testing.assert_array_equal(frames[7].image_dn, frames[1].image_dn)
    np.testing.assert_allclose(np.diff([f.timestamp_s for f in frames]), 1.0 / RATE_HZ, atol=1e-9)
    assert not source.is_over


@pytest.mark.parametrize("pixels", ["yuv420p", "gray", "gray10le"])
def test_the_luma_of_h264_is_what_the_codec_holds(tmp_path, pixels):
    path, size = tmp_path / "weld.mp4", (32, 48)
    rng = np.random.default_rng(1)
    top = 1023 if pixels == "gray10le" else 255
    images = [rng.integers(0, top + 1, size) for _ in range(5)]
    dtype = np.uint16 if top > 255 else np.uint8
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(50))
        stream.width, stream.height, stream.pix_fmt = size[1], size[0], pixels
        # Nothing is lost of the luma at a quantiser of 0.
        stream.options = {"qp": "0", "preset": "ultrafast"}
        for image in images:
            frame = av.VideoFrame(size[1], size[0], pixels)
            for n, plane in enumerate(frame.planes):
                stride = plane.line_size // np.dtype(dtype).itemsize
                held = np.full((plane.height, stride), 128, dtype)
                if n == 0:
                    held[:, : size[1]] = image
                plane.update(held.tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    video = LumaVideo(path)
    assert (video.shape, video.dtype, video.rate_hz) == (size, np.dtype(dtype), 50.0)
    for read, image in zip(video.frames(), images, strict=True):
        np.testing.assert_array_equal(read, image)


def test_a_folder_plays_its_images_by_their_numbers(tmp_path):
    setup = small_setup()
    folder = tmp_path / "images"
    folder.mkdir()
    frames = noise_frames(setup, 11)
    for frame in frames:
        cv2.imwrite(str(folder / f"shot_{frame.index}.png"), frame.image_dn)
    (folder / "shot_4.png").write_bytes(b"torn")
    played = all_of(folder_source(folder, setup, RATE_HZ, False, CaptureRequest))
    assert [frame.index for frame in played] == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10]
    np.testing.assert_array_equal(played[-1].image_dn, frames[10].image_dn)


def test_what_is_wrong_with_a_file_is_said(tmp_path):
    setup = small_setup()
    path = written(tmp_path / "weld.mkv", noise_frames(setup, 2), setup)
    with pytest.raises(ArctrackError, match=r"\[camera\] width and height say 49 x 36"):
        video_source(path, replace(setup, camera=replace(setup.camera, width=49)), False, CaptureRequest)
    with pytest.raises(ArctrackError, match=r"nothing.mkv: there is no such file"):
        video_source(tmp_path / "nothing.mkv", setup, False, CaptureRequest)
    (tmp_path / "text.mkv").write_text("no video")
    with pytest.raises(ArctrackError, match=r"text.mkv: cannot be read as a video"):
        video_source(tmp_path / "text.mkv", setup, False, CaptureRequest)
    with pytest.raises(ArctrackError, match=r"is no folder"):
        folder_source(path, setup, RATE_HZ, False, CaptureRequest)
    with pytest.raises(ArctrackError, match=r"\[camera\] name = '/dev/video97': cannot be opened"):
        DeviceSource("/dev/video97", setup, RATE_HZ)


def test_opencv_reads_a_grey_file_by_the_class_that_reads_devices(tmp_path):
    setup = small_setup()
    frames = noise_frames(setup, 6)
    path = tmp_path / "grey.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=Fraction(50))
        stream.width, stream.height, stream.pix_fmt = setup.camera.width, setup.camera.height, "gray"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image_dn, format="gray")))
        container.mux(stream.encode())
    source = DeviceSource(str(path), setup, 50.0)
    source.begin()
    # The first frame showed that it fits.
    for n in range(1, 6):
        asked_s = time.monotonic()
        frame = source.read()
        np.testing.assert_array_equal(frame.image_dn, frames[n].image_dn)
        # A file's own time is no time of this machine: the arrival counts.
        assert asked_s <= frame.timestamp_s + frame.exposure_s / 2.0 <= time.monotonic()
        assert frame.index == n - 1
    with pytest.raises(ArctrackError, match="gives no frame any more"):
        source.read()
    source.close()
    assert source.is_over


@pytest.mark.slow
def test_a_process_beside_captures_a_video_and_ends_with_it(tmp_path):
    setup = small_setup()
    frames = noise_frames(setup, 12)
    path = tmp_path / "weld.mkv"
    with VideoWriter(path, setup.camera.width, setup.camera.height, setup.sensor.dtype, 20.0) as video:
        for frame in frames:
            video.write(frame.image_dn, frame.timestamp_s)
    choice = CameraChoice(20.0, "video", "weld.mkv", CaptureChoice())
    camera = CapturedCamera(choice, tmp_path / "cell.toml", setup)
    shared = camera.frames_path
    assert shared.exists()
    assert camera.newest() is None
    camera.begin()
    read, until_s = [], time.monotonic() + PATIENCE_S
    while not camera.is_over and time.monotonic() < until_s:
        frame = camera.newest()
        if frame is not None:
            read.append(frame)
        time.sleep(0.001)
    assert camera.is_over
    assert len(read) + camera.dropped == 12
    for frame in read:
        np.testing.assert_array_equal(frame.image_dn, frames[frame.index].image_dn)
    camera.close()
    assert not shared.exists()
    with pytest.raises(ArctrackError, match=r"other.mkv: there is no such file"):
        CapturedCamera(replace(choice, name="other.mkv"), tmp_path / "cell.toml", setup)


PARENT = """
    import sys, time
    from pathlib import Path
    sys.path.insert(0, sys.argv[2])
    from made import small_setup
    from arctrack.control.cell_file import CameraChoice, CaptureChoice
    from arctrack.live.serve.captured_camera import CapturedCamera

    if __name__ == "__main__":
        choice = CameraChoice(20.0, "video", "weld.mkv", CaptureChoice(loop=True))
        camera = CapturedCamera(choice, Path(sys.argv[1]) / "cell.toml", small_setup())
        camera.begin()
        while camera.newest() is None:
            time.sleep(0.01)
        print(camera.frames_path, flush=True)
        time.sleep(600.0)
"""


@pytest.mark.slow
def test_what_captures_ends_with_a_parent_that_is_killed(tmp_path):
    setup = small_setup()
    written(tmp_path / "weld.mkv", noise_frames(setup, 3), setup)
    script = tmp_path / "parent.py"
    script.write_text(textwrap.dedent(PARENT))
    command = [sys.executable, str(script), str(tmp_path), str(Path(__file__).parents[3])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        shared = Path(parent.stdout.readline().strip())
        assert shared.is_file()
        parent.send_signal(signal.SIGKILL)
        until_s = time.monotonic() + PATIENCE_S
        while shared.exists() and time.monotonic() < until_s:
            time.sleep(0.05)
    assert not shared.exists()


@given(
    begin_s=st.floats(0.0, 1000.0),
    period_s=st.floats(0.01, 1.0),
    share=st.floats(0.1, 0.9),
    exposure_s=st.floats(0.0001, 0.02),
    due_s=st.floats(1000.0, 1010.0),
)
def test_a_frame_is_triggered_in_the_middle_of_the_first_base_phase(
    begin_s, period_s, share, exposure_s, due_s
):
    wanted = CaptureRequest(0.0, np.nan, begin_s, period_s, share * period_s, 2000.0)
    at_s = trigger_at_s(wanted, exposure_s, due_s, 1000.0)
    if not is_reached(wanted, exposure_s, 1000.0):
        assert at_s == due_s
        return
    assert due_s - 1e-9 <= at_s <= due_s + period_s + 1e-9
    phase_s = (at_s - begin_s + 1e-7) % period_s - 1e-7
    assert phase_s >= SLACK_S - 1e-6
    assert phase_s + exposure_s <= wanted.base_s - SLACK_S + 1e-6
    assert trigger_at_s(wanted, exposure_s, due_s, 3000.0) == due_s
