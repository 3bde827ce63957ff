import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from made import noise_frames, results_of, small_setup, write
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording import Truth, read_recording
from arctrack.recording.results import COLUMNS, FILES, FINISHED_JSON, REPLAY_MCAP, REPLAY_RRD, Latency
from arctrack.recording.score import score
from arctrack.replay.pages.pictures import exporter
from arctrack.replay.replay import ReplayOptions, parse_bus, replay_recording, track_alone
from robot_io import BusLogReader, SeamOffset, Source, TrackerStatus, Validity
from tracker.state import Track

QUICK = ReplayOptions(pictures=False)


@pytest.mark.slow
def test_a_replay_tracks_and_writes_every_file(simulated: Path, tmp_path: Path) -> None:
    recording = read_recording(simulated)
    seen: list[int] = []
    done = replay_recording(recording, tmp_path, on_frame=seen.append)
    assert seen == list(range(1, 15))
    assert done.complaint is None
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "bus.blf",
        "overlay.mp4",
        "overview.png",
        "replay.html",
        "results.csv",
        "summary.json",
    ]
    rows = results_of(tmp_path)
    assert tuple(rows[0]) == COLUMNS
    lit = [row.laser_on for row in recording.rows]
    assert [row["valid"] == "1" for row in rows] == lit
    assert [row["seam_y_mm"] != "" for row in rows] == lit
    assert all("laser_off" in row["flags"].split("|") for row, on in zip(rows, lit, strict=True) if not on)
    assert [row["arc_level_sigma"] != "" for row in rows] == [row["arc_level"] != "" for row in rows]
    stated_mm = recording.setup.arc.center_in_tool_mm[2]
    heights = [row for row in rows if row["arc_height_mm"]]
    assert heights
    assert all(row["arc_level"] for row in heights)
    off = [(float(row["arc_height_mm"]) - stated_mm) / float(row["arc_height_sigma_mm"]) for row in heights]
    assert np.abs(off).max() < 3.0
    assert [row["arc_height_unknown"] == "" for row in rows] == [row["arc_height_mm"] != "" for row in rows]
    assert {row["arc_height_unknown"] for row in rows} >= {"", "no_arc"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    seen = {"laser_on": sum(lit), "valid": sum(lit), "invalid": 14 - sum(lit)}
    assert summary["frames"] == {"total": 14, **seen, "unreadable": 0}
    assert summary["flags"]["laser_off"] == 14 - sum(lit)
    assert summary["error_mm"]["valid_frames_beyond_limit"] == 0
    assert summary["error_mm"]["lateral"]["with_constant_part_removed"]["rms"] < 0.1
    assert summary["latency_ms"]["p50"] <= summary["latency_ms"]["max"]
    with av.open(str(tmp_path / "overlay.mp4")) as video:
        stream = video.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.format.name == "yuv420p"
        assert stream.width % 2 == stream.height % 2 == 0
        assert sum(1 for _ in video.decode(stream)) == 14
    assert cv2.imread(str(tmp_path / "overview.png")).shape[1] > 1000


def test_what_is_in_the_results_went_over_the_bus(simulated: Path, tmp_path: Path) -> None:
    recording = read_recording(simulated)
    replay_recording(recording, tmp_path, QUICK)
    received = list(BusLogReader(tmp_path / "bus.blf"))
    offsets = [r for r in received if isinstance(r.message, SeamOffset)]
    assert sum(isinstance(r.message, TrackerStatus) for r in received) == len(recording.rows) + 1
    assert {r.source for r in received} == {Source.REPLAY}
    last = offsets.pop().message
    assert isinstance(last, SeamOffset)
    assert last.validity is Validity.REFUSED
    for row, frame, entry in zip(results_of(tmp_path), recording.rows, offsets, strict=True):
        assert entry.timestamp_s == pytest.approx(frame.timestamp_s + frame.exposure_s / 2.0, abs=1e-5)
        message = entry.message
        assert isinstance(message, SeamOffset)
        if message.validity is Validity.REFUSED:
            assert row["offset_y_mm"] == row["offset_z_mm"] == ""
        else:
            assert float(row["offset_y_mm"]) == pytest.approx(message.offset_y_mm, abs=1e-3)
            assert float(row["offset_z_mm"]) == pytest.approx(message.offset_z_mm, abs=1e-3)
    assert any(row["offset_y_mm"] for row in results_of(tmp_path))


@pytest.mark.slow
def test_a_second_replay_gives_the_same_numbers(simulated: Path, tmp_path: Path) -> None:
    def without_wall_time(folder: Path) -> list[dict[str, str]]:
        replay_recording(read_recording(simulated), folder, QUICK)
        return [{k: v for k, v in row.items() if k != "compute_ms"} for row in results_of(folder)]

    assert without_wall_time(tmp_path / "a") == without_wall_time(tmp_path / "b")


@pytest.mark.slow
def test_the_truth_never_reaches_the_tracker(simulated: Path, tmp_path: Path) -> None:
    shutil.copytree(simulated, tmp_path / "r")
    (tmp_path / "r" / "truth.csv").unlink()
    blind = replay_recording(read_recording(tmp_path / "r"), tmp_path / "blind", QUICK)
    seeing = replay_recording(read_recording(simulated), tmp_path / "seeing", QUICK)
    assert repr(blind.tracks) == repr(seeing.tracks)
    assert blind.summary.score is None
    assert "error_mm" not in json.loads((tmp_path / "blind" / "summary.json").read_text())


@pytest.mark.slow
def test_without_the_arc_map_it_runs_as_well(simulated: Path, tmp_path: Path) -> None:
    recording = read_recording(simulated)
    done = replay_recording(recording, tmp_path, replace(QUICK, use_arc_map=False))
    assert not done.summary.use_arc_map
    assert json.loads((tmp_path / "summary.json").read_text())["arc_map"] is False
    beside = track_alone(recording, True)
    assert beside.use_arc_map
    assert beside.score is not None


@pytest.mark.slow
def test_bad_frames_are_flagged_and_the_tracking_goes_on(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    expected = replay_recording(read_recording(path), tmp_path / "whole", QUICK)
    frame = path / "frames" / "000005.png"
    frame.write_bytes(frame.read_bytes()[:500])
    done = replay_recording(read_recording(path), tmp_path / "cut")
    rows = results_of(tmp_path / "cut")
    assert rows[5] == {name: "" for name in COLUMNS} | {
        "frame": "5",
        "timestamp_s": "0.500000",
        "arc_height_unknown": "not_tracked",
        "valid": "0",
        "flags": "frame_unreadable",
        "offset_y_mm": rows[5]["offset_y_mm"],
        "offset_z_mm": rows[5]["offset_z_mm"],
        "validity": "held",
        "gate_reason": "not_measured",
    }
    assert [t.valid for t in done.tracks[6:]] == [t.valid for t in expected.tracks[6:]]
    assert done.complaint is not None
    assert "000005.png: is truncated after 500 bytes; 1 of 14 frames" in done.complaint
    assert json.loads((tmp_path / "cut" / "summary.json").read_text())["frames"]["unreadable"] == 1


def test_frames_before_the_poses_and_after_them_are_refused(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    lines = (path / "poses.csv").read_text().splitlines()
    some = [line for line in lines[1:] if 0.35 < float(line.split(",")[0]) < 1.05]
    (path / "poses.csv").write_text("\n".join([lines[0], *some]))
    recording = read_recording(path)
    first, last = recording.warnings
    assert "the first pose is at 0.3" in first
    assert "the last pose is at 1.0" in last
    done = replay_recording(recording, tmp_path / "out", QUICK)
    refused = [("pose_refused" in t.flag_names) for t in done.tracks]
    assert refused == [True] * 4 + [False] * 7 + [True] * 3


def test_rows_before_a_crash_are_kept(simulated: Path, tmp_path: Path) -> None:
    def crash(done: int) -> None:
        if done == 6:
            assert len(results_of(tmp_path)) == 6
            raise KeyboardInterrupt

    (tmp_path / "summary.json").write_text("from an earlier replay")
    with pytest.raises(KeyboardInterrupt):
        replay_recording(read_recording(simulated), tmp_path, on_frame=crash)
    assert len(results_of(tmp_path)) == 6
    offsets = [r.message for r in BusLogReader(tmp_path / "bus.blf") if isinstance(r.message, SeamOffset)]
    # Six frames, and the last word.
    assert len(offsets) == 7
    assert offsets[-1].validity is Validity.REFUSED
    with av.open(str(tmp_path / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 6
    assert not (tmp_path / "summary.json").exists()


@pytest.mark.slow
def test_noise_is_tracked_without_complaint(tmp_path: Path) -> None:
    setup = small_setup(bits=12)
    recording = read_recording(write(tmp_path / "r", setup, noise_frames(setup, 4)))
    done = replay_recording(recording)
    assert done.folder == tmp_path / "r" / "results"
    assert (done.folder / "overview.png").exists()
    assert len(results_of(done.folder)) == 4


@pytest.mark.slow
def test_a_colon_in_a_relative_folder_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    setup = small_setup()
    recording = read_recording(write(Path("10:30"), setup, noise_frames(setup, 2)))
    assert (replay_recording(recording).folder / "overlay.mp4").exists()


def test_buses(simulated: Path, tmp_path: Path) -> None:
    assert parse_bus("socketcan:can0") == ("socketcan", "can0")
    assert parse_bus("slcan:/dev/ttyACM0@115200:x") == ("slcan", "/dev/ttyACM0@115200:x")
    for text in ("virtual", ":x", "x:", ""):
        with pytest.raises(ArctrackError, match="interface:channel"):
            parse_bus(text)
    with pytest.raises(ArctrackError, match="nosuchbus"):
        replay_recording(read_recording(simulated), tmp_path, replace(QUICK, bus="nosuchbus:1"))


def test_a_bad_truth_is_noticed_before_anything_is_sent(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    (path / "truth.csv").write_text("frame,seam_x_mm,seam_y_mm,seam_z_mm\n0,1,2\n")
    with pytest.raises(ArctrackError, match=r"truth\.csv, line 2: has 3 values"):
        replay_recording(read_recording(path), tmp_path / "out", QUICK)
    assert not (tmp_path / "out").exists()


def test_a_recording_that_begins_before_0(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    lines = (path / "frames.csv").read_text().splitlines()
    assert lines[1].startswith("0,0.000000,")
    lines[1] = lines[1].replace("0,0.000000,", "0,-0.100000,")
    (path / "frames.csv").write_text("\n".join(lines))
    recording = read_recording(path)
    done = replay_recording(recording, tmp_path / "out", QUICK)
    (warning,) = done.warnings
    assert "in bus.blf all times are 1 s later" in warning
    offsets = [r for r in BusLogReader(tmp_path / "out" / "bus.blf") if isinstance(r.message, SeamOffset)]
    assert [r.timestamp_s for r in offsets[:-1]] == pytest.approx(
        [row.timestamp_s + row.exposure_s / 2.0 + 1.0 for row in recording.rows], abs=1e-5
    )
    assert results_of(tmp_path / "out")[0]["timestamp_s"] == "-0.100000"


def test_a_folder_that_cannot_be_written(simulated: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ArctrackError, match="choose another with --out"):
        replay_recording(read_recording(simulated), tmp_path / "file" / "out", QUICK)


def test_score_by_hand() -> None:
    truth = Truth(np.array([0, 1, 2, 3]), np.zeros((4, 3)))
    seams = [(0.0, 0.1, 0.0), (0.0, 0.3, 0.0), (0.0, 0.2, -0.3), (0.0, float("nan"), float("nan"))]
    tracks = [Track(n, 0.1 * n, 0, seam_tool_mm=seam) for n, seam in enumerate(seams)]
    tracks.append(Track(9, 0.9, 0, seam_tool_mm=(0.0, 5.0, 5.0)))
    scored = score(tracks, truth, 0.25)
    assert scored is not None
    assert scored.frames == 3
    assert scored.beyond_limit == 2
    assert scored.lateral.constant_mm == pytest.approx(0.2)
    assert scored.lateral.whole.rms == pytest.approx(np.sqrt((0.01 + 0.09 + 0.04) / 3))
    assert scored.lateral.whole.median == pytest.approx(0.2)
    assert scored.lateral.whole.max == pytest.approx(0.3)
    assert scored.lateral.without_constant.rms == pytest.approx(np.sqrt(0.02 / 3))
    assert scored.vertical.whole.max == pytest.approx(0.3)
    assert score(tracks[3:], truth, 0.25) is None


def test_latency_of_nothing_is_unknown() -> None:
    assert np.isnan(Latency.of([float("nan")]).p50)
    assert Latency.of([1.0, float("nan"), 3.0]).max == 3.0


@pytest.mark.slow
def test_pictures_are_drawn_when_the_last_offset_is_out(simulated: Path, tmp_path: Path) -> None:
    done: list[tuple[str, int]] = []
    replay_recording(
        read_recording(simulated),
        tmp_path,
        on_frame=lambda n: done.append(("replayed", n)),
        on_drawn=lambda n: done.append(("drawn", n)),
    )
    assert done == [(what, n) for what in ("replayed", "drawn") for n in range(1, 15)]
    with av.open(str(tmp_path / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 14
    assert {path.name for path in tmp_path.iterdir()} == set(FILES) - {REPLAY_MCAP, REPLAY_RRD, FINISHED_JSON}


@pytest.mark.parametrize(
    ("name", "package", "extra"), [(REPLAY_MCAP, "mcap", "mcap"), (REPLAY_RRD, "rerun", "rerun")]
)
def test_without_its_package_an_export_says_how_to_get_it(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    for module in list(sys.modules):
        if module.split(".")[0] == package or module.endswith((".mcap_file", ".rrd_file")):
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ArctrackError, match=rf"^{name}: needs .*pip install 'arctrack\[{extra}\]'$"):
        exporter(name)
    done = CliRunner().invoke(
        app, ["replay", str(simulated), "--out", str(tmp_path), f"--{name.split('.')[1]}"]
    )
    assert done.exit_code == 2
    assert f"pip install 'arctrack[{extra}]'" in done.output
    # It is said before anything is tracked.
    assert not (tmp_path / "results.csv").exists()
