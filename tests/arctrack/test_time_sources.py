"""Times of frames by several sources: what contradicts what, and by how much."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from made import noise_frames, small_setup
from PIL import Image
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording import VideoFormat, format_setup, read_recording
from arctrack.recording.ffv1 import index_of
from arctrack.recording.importing.image_files import find_images, recognized_times, times_in_names
from arctrack.recording.importing.units import UNSTATED
from arctrack.recording.time_sources import TimeSource, contradictions
from arctrack.recording.writer import RecordingWriter
from noise_model.compiled.arrays import Float64

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
EVERY_100_MS = 0.1 * np.arange(24)
STALLED = EVERY_100_MS + 3.0 * (np.arange(24) >= 10)


def told(used: Float64, other: Float64, *, resolution_s: float = 0.0, is_count: bool = False) -> list[str]:
    source = TimeSource("B", other, resolution_s, is_count)
    return [*contradictions(TimeSource("A", used), [source], range(len(used)))]


@pytest.mark.parametrize(
    ("other", "line"),
    [
        (1e9 + EVERY_100_MS, None),
        (EVERY_100_MS + 0.02 * np.sin(np.arange(24)), None),
        (np.full(24, 7.0), None),
        (np.full(24, np.nan), None),
        (STALLED, "B contradict A from frame 10 on: 4 s where 1 s, counted from frame 0"),
        (
            1.25 * EVERY_100_MS,
            "B contradict A by their rate, 8 frames a second where 10; frame 3: 0.375 s where 0.3 s, "
            "counted from frame 0",
        ),
        (
            np.where(np.arange(24) == 5, 9.0, EVERY_100_MS),
            "B contradict A in 1 of 24 frames, the first frame 5: 9 s where 0.5 s, counted from frame 0",
        ),
    ],
)
def test_another_clock(other: Float64, line: str | None) -> None:
    assert told(EVERY_100_MS, other) == ([] if line is None else [line])


def test_what_a_clock_is_rounded_to_is_no_contradiction() -> None:
    whole_s = np.floor(EVERY_100_MS + 0.35)
    assert told(EVERY_100_MS, whole_s, resolution_s=1.0) == []
    assert len(told(EVERY_100_MS, whole_s)) == 1
    (line,) = told(EVERY_100_MS, np.floor(STALLED), resolution_s=1.0)
    assert "from frame 10 on: 4 s where 1 s" in line


@pytest.mark.parametrize(
    ("times_s", "counts", "line"),
    [
        (EVERY_100_MS, np.arange(24.0), None),
        (STALLED, np.arange(24.0) + 30.0 * (np.arange(24) >= 10), None),
        (np.cumsum(np.geomspace(0.01, 10.0, 24)), np.arange(24.0), None),
        (
            STALLED,
            np.arange(24.0),
            "A go from frame 9 to frame 10 in 3.1 s, B by 1 where 0.1 s are the rule: "
            "some 30 frames are lost",
        ),
        (
            EVERY_100_MS,
            np.arange(24.0) + 7.0 * (np.arange(24) >= 10),
            "A go from frame 9 to frame 10 in 0.1 s, B by 8 where 0.1 s are the rule: 7 numbers have no time",
        ),
        (EVERY_100_MS, np.arange(24.0) % 20, "B contradict A at frame 20: they go from 19 to 0"),
    ],
)
def test_a_counter(times_s: Float64, counts: Float64, line: str | None) -> None:
    assert told(times_s, counts, is_count=True) == ([] if line is None else [line])


@pytest.mark.parametrize(
    ("names", "seconds"),
    [
        (["20240131_235959123", "20240201_000000223"], [0.0, 1.1]),
        (["cam2_2024-02-28T23-59-59.9_x", "cam2_2024-02-29T00-00-00.4_x"], [0.0, 0.5]),
        (["2024-01-31 10.00.00,250000", "2024-01-31 10.00.01,500000"], [0.0, 1.25]),
        (["Image__2024-01-31__23-59-58__0001", "Image__2024-01-31__23-59-59__0002"], [0.0, 1.0]),
        (["20240131_235958_001", "20240131_235958_101"], [0.0, 0.1]),
        (["05-59-59_9", "05-59-59_90", "06-00-00_1"], [0.0, 0.081, 0.992]),
        (["a_23-59-59", "a_00-00-01"], [0.0, 2.0]),
        (["cam_31-01-2024_23-59-59", "cam_01-02-2024_00-00-01"], [0.0, 2.0]),
        (["cam_01-31-2024 23.59.59.5", "cam_02-01-2024 00.00.01.0"], [0.0, 1.5]),
        (["1403636579763555584", "1403636579813555456"], [0.0, 0.049999872]),
        (["f1706745599123.5", "f1706745599223.5"], [0.0, 0.1]),
    ],
)
def test_times_in_names(names: list[str], seconds: list[float]) -> None:
    times = recognized_times([Path(f"{name}.png") for name in names])[0]
    np.testing.assert_allclose(times.values - times.values[0], seconds, atol=1e-6)


def test_a_counter_behind_a_time_is_held_against_it() -> None:
    names = [f"20240131_2359{n:02d}_{n + 3 * (n > 4):04d}.png" for n in range(10)]
    times, counts = recognized_times([Path(name) for name in names])
    (line,) = contradictions(times, [counts], range(10))
    assert line.endswith("by 4 where 1 s are the rule: 3 numbers have no time")


def test_a_date_needs_no_unit() -> None:
    paths = [Path("a_20240131_235959.png"), Path("a_20240201_000000.png")]
    assert np.diff(times_in_names(paths, UNSTATED).values).tolist() == [1.0]


@pytest.mark.parametrize(
    ("numbers", "last"), [((65534, 65535, 0, 1), 65535), ((9998, 9999, 1, 2), 9999), ((254, 255, 0), 255)]
)
def test_a_counter_that_begins_anew(numbers: tuple[int, ...], last: int, tmp_path: Path) -> None:
    for number in numbers:
        (tmp_path / f"img_{number:04d}.png").write_bytes(b"")
    series = find_images([tmp_path])
    assert [int(path.stem[4:]) for path in series.paths] == [*numbers]
    assert series.indices == tuple(range(numbers[0], numbers[0] + len(numbers)))
    assert series.notes[0].startswith(f"the numbers begin anew after {last}: img_000")


def imported(folder: Path, source: Path, *options: object) -> tuple[int, str]:
    setup, poses = folder / "setup.toml", folder / "poses.csv"
    setup.write_text(format_setup(small_setup()))
    rows = "".join(f"{0.1 * n - 0.2:.1f},{n},0,500,0,0,0,1\n" for n in range(80))
    poses.write_text("timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n" + rows)
    files = ["--setup", setup, "--poses", poses, "--out", folder / "out"]
    done = RUNNER.invoke(app, [str(word) for word in ("import", source, *files, *options)])
    if isinstance(done.exception, ArctrackError):
        return 2, str(done.exception)
    return done.exit_code, done.output


def recorded(folder: Path, times_s: Float64) -> Path:
    """Write a recording with a video whose frames have times."""
    setup = small_setup()
    with RecordingWriter(folder, setup, video=VideoFormat(10.0)) as writer:
        for frame, timestamp_s in zip(noise_frames(setup, len(times_s)), times_s, strict=True):
            writer.write_frame(type(frame)(**{**vars(frame), "timestamp_s": float(timestamp_s)}))
        for n in range(80):
            writer.write_pose(0.1 * n - 0.2, np.eye(4))
    return folder


def test_a_video_carries_the_times_of_its_frames(tmp_path: Path) -> None:
    video = recorded(tmp_path / "r", STALLED) / "frames.mkv"
    np.testing.assert_allclose(index_of(video).times.values, STALLED, atol=1e-9)
    assert index_of(video).breaks_off is None
    assert read_recording(tmp_path / "r").warnings == ()


def test_a_videos_own_times_are_held_against_the_rate(tmp_path: Path) -> None:
    video = recorded(tmp_path / "r", STALLED) / "frames.mkv"
    code, said = imported(tmp_path, video, "--rate-hz", 10)
    assert code == 0
    assert "the video's own times contradict --rate-hz 10 from frame 10 on: 4 s where 1 s" in said


def test_a_videos_own_times_are_taken_where_nothing_else_is_stated(tmp_path: Path) -> None:
    video = recorded(tmp_path / "r", STALLED) / "frames.mkv"
    code, said = imported(tmp_path, video)
    assert code == 0
    assert "times       the video's own times: 0 to 5.3 s" in said
    assert "go from frame 9 to frame 10 in 3.1 s" in said
    times_s = [row.timestamp_s for row in read_recording(tmp_path / "out").rows]
    np.testing.assert_allclose(times_s, STALLED)


def test_a_recordings_video_is_held_against_its_table(tmp_path: Path) -> None:
    recording = recorded(tmp_path / "r", STALLED)
    lines = (recording / "frames.csv").read_text().splitlines()
    for n, line in enumerate(lines[1:]):
        cells = line.split(",")
        lines[n + 1] = ",".join([cells[0], f"{0.1 * n:.6f}", *cells[2:]])
    (recording / "frames.csv").write_text("\n".join(lines) + "\n")
    (warning,) = read_recording(recording).warnings
    assert warning == (
        f"{recording / 'frames.mkv'}: the video's own times contradict those of frames.csv from frame 10 on: "
        "4 s where 1 s, counted from frame 0"
    )


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_video_that_was_cut_says_so(share: float, tmp_path: Path) -> None:
    video = recorded(tmp_path / "r", EVERY_100_MS) / "frames.mkv"
    size = video.stat().st_size
    os.truncate(video, int(share * size))
    count = len(index_of(video))
    assert 0 < count < 24
    line = f"{video} breaks off in frame {count}: {int(share * size)} of {size} bytes are there"
    assert line in read_recording(tmp_path / "r").warnings
    code, said = imported(tmp_path, video, "--rate-hz", 10)
    assert (code, line in said) == (0, True)
    assert len(read_recording(tmp_path / "out").rows) == count


def test_a_video_without_its_index_has_all_frames(tmp_path: Path) -> None:
    video = recorded(tmp_path / "r", EVERY_100_MS) / "frames.mkv"
    os.truncate(video, video.stat().st_size - 20)
    assert len(index_of(video)) == 24
    assert f"{video} breaks off after its last frame, 23: " in str(index_of(video).breaks_off)


KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from arctrack.recording.ffv1 import VideoWriter
video = VideoWriter(Path(sys.argv[1]), 48, 36, np.uint8, 10.0)
rng = np.random.default_rng(0)
for n in range(600):
    video.write(rng.integers(0, 256, (36, 48), np.uint8), 0.1 * n)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_video_whose_writer_was_killed_breaks_off(tmp_path: Path) -> None:
    video = tmp_path / "v.mkv"
    done = subprocess.run([sys.executable, "-c", KILLED, str(video)], check=False)
    assert done.returncode == -signal.SIGKILL
    count = len(index_of(video))
    assert 0 < count < 600
    assert index_of(video).breaks_off == f"{video} breaks off in frame {count}: its writer did not finish it"


def written_video(path: Path, streams: int, turned_deg: int = 0, **tags: int) -> Path:
    frame = np.zeros((36, 48), np.uint8)
    with av.open(str(path), mode="w") as video:
        made = [video.add_stream("ffv1", rate=Fraction(10)) for _ in range(streams)]
        for stream in made:
            stream.width, stream.height, stream.pix_fmt = 48, 36, "gray"
            if turned_deg:
                stream.set_display_rotation(turned_deg)
            for name, value in tags.items():
                setattr(stream.codec_context, name, value)
        for stream in made:
            image = av.VideoFrame.from_ndarray(frame, format="gray")
            for name, value in tags.items():
                setattr(image, name, value)
            video.mux(stream.encode(image))
            video.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("streams", "tags", "line"),
    [
        (1, {"color_range": 1}, "its colour range is limited: black is not 0"),
        (2, {}, "holds 2 videos: write each to a file of its own"),
        (1, {"color_range": 2}, None),
        (1, {"turned_deg": 90}, "the video asks to be turned by 90 degrees: write it as the sensor gave it"),
    ],
)
def test_what_a_video_says_of_its_levels(
    streams: int, tags: dict[str, int], line: str | None, tmp_path: Path
) -> None:
    code, said = imported(tmp_path, written_video(tmp_path / "v.mkv", streams, **tags), "--rate-hz", 10)
    assert (code, line is None or line in said) == (0 if line is None else 2, True)


def images(folder: Path, names: list[str], times: list[str] | None = None) -> Path:
    (folder / "photos").mkdir()
    for n, name in enumerate(names):
        image = np.random.default_rng(n).integers(0, 256, (36, 48), np.uint8)
        if times is None:
            cv2.imwrite(str(folder / "photos" / name), image)
        else:
            Image.fromarray(image).save(folder / "photos" / name, tiffinfo={306: times[n]})
    return folder / "photos"


def test_times_in_names_are_held_against_the_rate(tmp_path: Path) -> None:
    photos = images(tmp_path, [f"f_20240131_2359{n + 9 * (n > 2):02d}.png" for n in range(8)])
    code, said = imported(tmp_path, photos, "--rate-hz", 1)
    assert code == 0
    assert f"{photos}: the times in the names contradict --rate-hz 1 from frame 3 on: 12 s where 3 s" in said


def test_times_of_day_are_no_frame_numbers(tmp_path: Path) -> None:
    photos = images(tmp_path, ["f_20240131_225958.png", "f_20240131_225959.png", "f_20240131_230000.png"])
    code, said = imported(tmp_path, photos, "--rate-hz", 1)
    assert (code, "contradict" in said) == (0, False)
    assert [row.timestamp_s for row in read_recording(tmp_path / "out").rows] == [0.0, 1.0, 2.0]


def test_times_in_tags_are_held_against_the_rate(tmp_path: Path) -> None:
    times = [f"2024:01:31 23:59:{n + 9 * (n > 2):02d}" for n in range(8)]
    photos = images(tmp_path, [f"f_{n}.tif" for n in range(8)], times)
    code, said = imported(tmp_path, photos, "--rate-hz", 1)
    assert code == 0
    assert "the times in the images' tags contradict --rate-hz 1 from frame 3 on: 12 s where 3 s" in said


def test_rows_of_poses_that_name_images_are_held_against_the_rate(tmp_path: Path) -> None:
    photos = images(tmp_path, [f"f_{n}.png" for n in range(8)])
    setup, poses = tmp_path / "setup.toml", tmp_path / "robot.csv"
    setup.write_text(format_setup(small_setup()))
    # A path at 20 Hz: every other row names the image that was taken then.
    rows = [f"{0.05 * n + (n > 9):.2f},{n},0,500,0,0,0,1,{'' if n % 2 else n // 2}\n" for n in range(80)]
    poses.write_text("timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw,frame\n" + "".join(rows))
    words = ["import", photos, "--setup", setup, "--poses", poses, "--out", tmp_path / "out", "--rate-hz", 10]
    done = RUNNER.invoke(app, [str(word) for word in words])
    assert done.exit_code == 0
    assert "the rows of robot.csv contradict --rate-hz 10 from frame 5 on: 1.5 s where 0.5 s" in done.output


def test_two_stated_times_that_differ_are_refused_with_both(tmp_path: Path) -> None:
    photos = images(tmp_path, [f"f_{n}.png" for n in range(8)])
    (tmp_path / "f.csv").write_text("time_s\n" + "".join(f"{0.125 * n}\n" for n in range(8)))
    code, said = imported(tmp_path, photos, "--frames", tmp_path / "f.csv", "--rate-hz", 10)
    assert code == 2
    assert said == (
        "the times of f.csv and --rate-hz 10 both state the images' times; leave one of them; --rate-hz 10 "
        "contradict the times of f.csv by their rate, 10 frames a second where 8; frame 3: 0.3 s where "
        "0.375 s, counted from frame 0"
    )


def test_lost_frames_of_a_table_are_told(tmp_path: Path) -> None:
    photos = images(tmp_path, [f"f_{n}.png" for n in range(8)])
    table = tmp_path / "f.csv"
    table.write_text("time_s\n" + "".join(f"{0.1 * n + 0.5 * (n > 3):.1f}\n" for n in range(8)))
    code, said = imported(tmp_path, photos, "--frames", table)
    assert code == 0
    assert (
        "the times of f.csv go from frame 3 to frame 4 in 0.6 s, the frames' numbers by 1 where 0.1 s" in said
    )
    assert "some 5 frames are lost" in said


def test_decimals_have_an_order_of_their_own(tmp_path: Path) -> None:
    photos = images(tmp_path, ["t_1.5.png", "t_1.25.png", "t_2.0.png"])
    code, said = imported(tmp_path, photos, "--rate-hz", 10)
    assert code == 2
    assert "t_1.25.png: comes after t_1.5.png by its numbers, before it as a decimal" in said
    code, said = imported(tmp_path, photos, "--times-in-names", "--units", "s")
    assert code == 0
    times_s = [row.timestamp_s for row in read_recording(tmp_path / "out").rows]
    assert times_s == [1.25, 1.5, 2.0]
