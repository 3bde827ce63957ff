"""Every bad input is one line on stderr that names the file and the key or line, and exit code 2."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made import noise_frames, replace_in, replace_line, small_setup, write

from arctrack import cli
from arctrack.recording import VideoFormat
from arctrack.recording.png import encode


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    setup = small_setup()
    return write(tmp_path_factory.mktemp("good") / "r", setup, noise_frames(setup, 4))


def toml(old: str, new: str) -> Callable[[Path], None]:
    return lambda path: replace_in(path / "recording.toml", old, new)


def line(file: str, number: int, text: str) -> Callable[[Path], None]:
    return lambda path: replace_line(path / file, number, text)


def gone(name: str) -> Callable[[Path], None]:
    def remove(path: Path) -> None:
        target = path / name
        shutil.rmtree(target) if target.is_dir() else target.unlink()

    return remove


def cut_poses(path: Path) -> None:
    lines = (path / "poses.csv").read_text().splitlines()
    (path / "poses.csv").write_text("\n".join(lines[:5]))


def cut_png(path: Path) -> None:
    png = path / "frames" / "000002.png"
    png.write_bytes(png.read_bytes()[:-30])


def small_png(path: Path) -> None:
    (path / "frames" / "000001.png").write_bytes(encode(np.zeros((10, 12), np.uint8)))


BAD_INPUTS: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "no setup": (gone("recording.toml"), "recording.toml", "no such file"),
    "no frames.csv": (gone("frames.csv"), "frames.csv", "no such file"),
    "no poses": (gone("poses.csv"), "poses.csv", "no poses"),
    "no frames": (gone("frames"), "frames", "no frames"),
    "one frame gone": (gone("frames/000002.png"), "000002.png", "no such file"),
    "no key": (toml("c2 = 112.0\n", ""), "recording.toml", "[material] c2: missing"),
    "no table": (toml("[material]", "[metal]"), "recording.toml", "[material]: missing"),
    "no dimension": (toml("depth_mm = 4.0\n", ""), "recording.toml", "[joint] depth_mm: missing"),
    "wrong type": (toml("bits = 8", "bits = 'eight'"), "recording.toml", "[sensor] bits = 'eight'"),
    "nan in setup": (toml("c2 = 112.0", "c2 = nan"), "recording.toml", "[material] c2 = nan"),
    "depth beyond a float": (
        toml("depth_mm = 4.0", f"depth_mm = 1{400 * '0'}"),
        "recording.toml",
        "[joint] depth_mm: must be a finite number",
    ),
    "depth beyond an integer": (
        toml("depth_mm = 4.0", f"depth_mm = 1{5000 * '0'}"),
        "recording.toml",
        "is no valid TOML",
    ),
    "inches": (
        toml("mm, s, deg, e-, DN", "inch, ms, rad"),
        "recording.toml",
        "units = 'inch, ms, rad': must be of mm, s, deg, e-, DN",
    ),
    "black beyond the code": (
        toml("black_level_dn = 4.0", "black_level_dn = -1e300"),
        "recording.toml",
        "[sensor] black_level_dn = -1e+300: input should be greater than or equal to -65535",
    ),
    "exponent of no arc": (
        toml("current_exponent = ", "current_exponent = 13000.0 #"),
        "recording.toml",
        "[arc] current_exponent = 13000.0: input should be less than or equal to 10",
    ),
    "image beyond memory": (
        toml("width = 48", "width = 320000000"),
        "recording.toml",
        "[camera] width = 320000000: input should be less than or equal to 16384",
    ),
    "charge beyond sense": (
        toml("peak_e = ", "peak_e = 1e300 #"),
        "recording.toml",
        "[laser] peak_e = 1e+300: input should be less than or equal to",
    ),
    "depth beyond sense": (
        toml("depth_mm = 4.0", "depth_mm = 1e300"),
        "recording.toml",
        "[joint] depth_mm = 1e+300: must be a finite number, 1e+15 at most",
    ),
    "colours": (
        toml('pixel_format = "mono8"', 'pixel_format = "BayerRG8"'),
        "recording.toml",
        "[camera] pixel_format = 'BayerRG8': must be a monochrome one",
    ),
    "c2 zero": (toml("c2 = 112.0", "c2 = 0.0"), "recording.toml", "[material] c2 = 0.0: must be > 0"),
    "c2 negative": (toml("c2 = 112.0", "c2 = -1"), "recording.toml", "[material] c2 = -1.0: must be > 0"),
    "no toml": (toml("[laser]", "[laser"), "recording.toml", "line"),
    "other format": (toml("recording/1", "recording/9"), "recording.toml", "format = "),
    "no rotation": (
        toml("quaternion_xyzw = [0.69", "quaternion_xyzw = [1.69"),
        "recording.toml",
        "[camera.pose_in_tool] quaternion_xyzw",
    ),
    "level laser": (
        toml("plane_in_tool = [1.0, 0.0, 0.0, -35.0]", "plane_in_tool = [0.0, 0.0, 1.0, 0.0]"),
        "recording.toml",
        "[laser] plane_in_tool",
    ),
    "unknown joint": (toml('"v_groove"', '"zigzag"'), "recording.toml", "[joint] type = 'zigzag'"),
    "frame times fall": (
        line("frames.csv", 4, "2,0.05,1,1,100,0.005"),
        "frames.csv, line 4",
        "times must rise",
    ),
    "frame time nan": (
        line("frames.csv", 3, "1,nan,1,1,100,0.005"),
        "frames.csv, line 3",
        "timestamp_s = 'nan'",
    ),
    "current nan": (line("frames.csv", 3, "1,0.1,1,1,nan,0.005"), "frames.csv, line 3", "current_a = 'nan'"),
    "frame time in ms": (
        line("frames.csv", 5, "3,1700000000000.5,1,1,100,0.005"),
        "frames.csv, line 5",
        "timestamp_s = 1.7e+12: is beyond 1e+11 s; give seconds, not ms or ns",
    ),
    "frame time before all": (
        line("frames.csv", 2, "0,-1e300,1,1,100,0.005"),
        "frames.csv, line 2",
        "timestamp_s = -1e+300: is beyond 1e+11 s",
    ),
    "endless exposure": (
        line("frames.csv", 3, "1,0.1,1,1,100,1e308"),
        "frames.csv, line 3",
        "exposure_s = 1e+308: must be <= 3600; give seconds",
    ),
    "lightning": (
        line("frames.csv", 3, "1,0.1,1,1,1e308,0.005"),
        "frames.csv, line 3",
        "current_a = 1e+308: must be <= 10000; give amperes",
    ),
    "no exposure": (line("frames.csv", 3, "1,0.1,1,1,100,0"), "frames.csv, line 3", "exposure_s = 0"),
    "short line": (line("frames.csv", 3, "1,0.1,1,1"), "frames.csv, line 3", "4 values"),
    "no column": (
        line("frames.csv", 1, "frame,timestamp_s,laser_on,arc_on,current,exposure_s"),
        "frames.csv, line 1",
        "current_a is missing",
    ),
    "laser half on": (line("frames.csv", 2, "0,0,0.5,1,100,0.005"), "frames.csv, line 2", "laser_on = '0.5'"),
    "pose times fall": (line("poses.csv", 9, "-1,0,0,1,0,0,0,1"), "poses.csv, line 9", "times must rise"),
    "pose nan": (line("poses.csv", 2, "-0.2,0,nan,1,0,0,0,1"), "poses.csv, line 2", "y_mm = 'nan'"),
    "pose no rotation": (line("poses.csv", 2, "-0.2,0,0,1,0,0,0,2"), "poses.csv, line 2", "no rotation"),
    "poses stop early": (cut_poses, "poses.csv", "poses stop before the frames"),
    "png truncated": (cut_png, "000002.png", "truncated"),
    "frame of another size": (small_png, "000001.png", "12 x 10, [camera] width and height say 48 x 36"),
}


@pytest.mark.parametrize("name", BAD_INPUTS)
@pytest.mark.parametrize("command", ["replay", "inspect"])
def test_bad_input(
    command: str,
    name: str,
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spoil, file, problem = BAD_INPUTS[name]
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    spoil(path)
    arguments = ["arctrack", command, str(path)]
    monkeypatch.setattr("sys.argv", [*arguments, "--no-pictures"] if command == "replay" else arguments)
    with pytest.raises(SystemExit) as exit_info:
        cli.main()
    assert exit_info.value.code == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith(f"arctrack: error: {path}")
    assert file in error
    assert problem in error


def test_a_disk_that_is_full(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "results.csv"))

    monkeypatch.setattr("arctrack.recording.results.ResultsWriter.write", full)
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(recording), "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    (error,) = capsys.readouterr().err.splitlines()
    assert error == f"arctrack: error: {tmp_path}/results.csv: No space left on device"


def test_a_full_disk_of_one_recording_does_not_stop_the_others(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    full, other = Path(shutil.copytree(recording, tmp_path / "full")), tmp_path / "other"
    shutil.copytree(recording, other)
    (full / "results").mkdir()
    (full / "results" / "bus.blf").symlink_to("/dev/full")
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(full), str(other), "--no-pictures"])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    (error,) = capsys.readouterr().err.splitlines()
    assert f"{full}/results/bus.blf: cannot be written: No space left on device" in error
    assert (other / "results" / "summary.json").exists()


def test_what_the_system_refuses_of_one_recording_does_not_stop_the_others(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    good = Path(shutil.copytree(recording, tmp_path / "good"))
    too_long = tmp_path / (300 * "x")
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(too_long), str(good), "--no-pictures"])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith(f"arctrack: error: {too_long}: ")
    assert (good / "results" / "summary.json").exists()


def test_a_video_of_another_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 3), video=VideoFormat(10.0))
    replace_in(path / "recording.toml", "width = 48", "width = 64")
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(path)])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    (error,) = capsys.readouterr().err.splitlines()
    assert "frames.mkv: is 48 x 36, [camera] width and height in recording.toml say 64 x 36" in error


def test_rows_of_a_recording_with_a_bad_frame_are_all_there(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    cut_png(path)
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(path), str(recording), "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert "its results would replace others" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", ["arctrack", "replay", str(path), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    rows = (tmp_path / "out" / "results.csv").read_text().splitlines()
    assert len(rows) == 5
    assert "frame_unreadable" in rows[3]
    assert (tmp_path / "out" / "summary.json").exists()
    assert (tmp_path / "out" / "overview.png").exists()


@pytest.mark.parametrize(
    ("command", "frame"), [(["inspect"], []), (["explain"], ["2"]), (["calibrate", "hand-eye"], [])]
)
@pytest.mark.parametrize(
    "name", ["recording.toml", "frames.csv", "poses.csv", "truth.csv", "can.blf", "frames/000001.png"]
)
def test_nothing_replaces_the_recording_that_is_read(
    command: list[str],
    frame: list[str],
    name: str,
    recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = Path(shutil.copytree(recording, tmp_path / "r"))
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    out = tmp_path / "r" / ".." / "r" / name
    monkeypatch.setattr("sys.argv", ["arctrack", *command, str(path), *frame, "--out", str(out)])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith(f"arctrack: error: {out}: is ")
    assert "itself; give --out another file" in error
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize(("command", "frame"), [("inspect", []), ("explain", ["2"])])
def test_a_folder_is_no_file_to_write(
    command: str,
    frame: list[str],
    recording: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.argv", ["arctrack", command, str(recording), *frame, "--out", "/"])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert capsys.readouterr().err == "arctrack: error: /: is a folder; give --out a file's name\n"


@pytest.mark.parametrize(("command", "frame"), [("replay", []), ("explain", ["2"]), ("diagnose", [])])
def test_a_folder_is_no_setup(
    command: str,
    frame: list[str],
    recording: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arguments = [command, str(recording), *frame, "--setup", str(recording)]
    monkeypatch.setattr("sys.argv", ["arctrack", *arguments])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    error = capsys.readouterr().err
    assert error == f"arctrack: error: {recording}: is a folder; give the recording.toml in it\n"
