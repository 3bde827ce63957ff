"""`arctrack import` of MCAP files: a replay's profiles come back whole, and ROS 2's point clouds are read."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import results_of
from profiler_setup import profiler_setup
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.recording import BadFrame, read_recording
from arctrack.recording.importing.profile_files import ColumnProfile, profiles_of
from arctrack.recording.importing.profile_layout import ProfileLayout
from noise_model.instrument.profiler import Profiler

mcap_writer = pytest.importorskip("mcap.writer")
ros2_writer = pytest.importorskip("mcap_ros2.writer")

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
PROFILER = Profiler(20, 0.5, 40.0, 150.0, np.eye(4))
M = ("layout=mcap", "up_mm=1000", "across_mm=1000")
POINT_CLOUD_2 = """\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""
FLOAT32, UINT16 = 7, 4


def run(*arguments: object) -> None:
    done = RUNNER.invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, done.output


def heights_mm(n: int) -> np.ndarray:
    """Return heights on the columns, of which some are none."""
    z_mm = 0.25 * np.arange(PROFILER.columns) - 2.0 + n
    z_mm[5 + n : 8 + n] = np.nan
    return z_mm


def cloud(n: int, order: str = "<", height: int = 1, padding: int = 0) -> dict[str, Any]:
    """Return a message of a profile's points in m: z up, x across, with bytes between the fields."""
    kind = np.dtype(
        {
            "names": ("x", "y", "z", "intensity"),
            "formats": (f"{order}f4", f"{order}f4", f"{order}f4", f"{order}u2"),
            "offsets": (0, 4, 8, 16),
            "itemsize": 20,
        }
    )
    points = np.zeros(PROFILER.columns, kind)
    z_mm = heights_mm(n)
    points["x"], points["z"] = np.where(np.isnan(z_mm), np.nan, PROFILER.y_mm) / 1e3, z_mm / 1e3
    points["y"], points["intensity"] = 7.0, 100 + n
    width = len(points) // height
    rows = points.view(np.uint8).reshape(height, 20 * width)
    data = np.pad(rows, ((0, 0), (0, padding))).tobytes()
    fields = [
        {"name": name, "offset": offset, "datatype": kind, "count": 1}
        for name, offset, kind in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, UINT16))
    ]
    return {
        "header": {"stamp": {"sec": 1_700_000_000, "nanosec": 100_000_000 * n}, "frame_id": "laser"},
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": order == ">",
        "point_step": 20,
        "row_step": 20 * width + padding,
        "data": data,
        "is_dense": False,
    }


def write_clouds(
    path: Path, *clouds: dict[str, Any], topics: tuple[str, ...] = ("/scan",), chunk_bytes: int = 1 << 20
) -> Path:
    with path.open("wb") as file:
        writer = ros2_writer.Writer(file, chunk_size=chunk_bytes)
        schema = writer.register_msgdef("sensor_msgs/msg/PointCloud2", POINT_CLOUD_2)
        for topic in topics:
            for n, message in enumerate(clouds):
                writer.write_message(topic, schema, message, log_time=n, publish_time=n)
        writer.finish()
    return path


def read(path: Path, *options: str) -> list[ColumnProfile]:
    return list(profiles_of(path, ProfileLayout.of(options), PROFILER))


@pytest.mark.slow
@pytest.mark.parametrize("has_sigmas", [False, True])
def test_a_replays_profiles_come_back_with_their_tracks(tmp_path: Path, has_sigmas: bool) -> None:
    setup, made, back = tmp_path / "recording.toml", tmp_path / "made", tmp_path / "back"
    text = profiler_setup(640, 0.06, range_mm=30.0, depth_mm=6.0, root_gap_mm=1.0)
    setup.write_text(text.replace("columns =", "point_sigma = true\ncolumns =") if has_sigmas else text)
    run("simulate", made, "--setup", setup, "--frames", 4, "--production")
    run("replay", made, "--mcap", "--no-pictures")
    mcap = made / "results" / "replay.mcap"
    poses, layout = ("--poses", made / "poses.csv"), ("--profile", "layout=mcap")
    run("import", mcap, "--setup", setup, *poses, *layout, "--out", back)
    before, after = read_recording(made), read_recording(back)
    assert len(after.rows) == len(before.rows) == 4
    for ours, theirs in zip(before.frames(), after.frames(), strict=True):
        assert not isinstance(ours, BadFrame)
        assert not isinstance(theirs, BadFrame)
        assert theirs.timestamp_s == pytest.approx(ours.timestamp_s, abs=1e-9)
        # Some columns have no height, and some an echo's.
        assert (ours.image_dn[0] == 0).any()
        assert len(ours.image_dn) == (3 if has_sigmas else 2)
        np.testing.assert_array_equal(theirs.image_dn, ours.image_dn)
    run("replay", back, "--no-pictures")
    for row, again in zip(results_of(made / "results"), results_of(back / "results"), strict=True):
        assert row["valid"] == again["valid"] == "1"
        assert row["flags"] == again["flags"]
        for name in ("seam_y_mm", "seam_z_mm", "sigma_y_mm", "gap_mm", "offset_y_mm"):
            assert row[name] == again[name]


@pytest.mark.parametrize(
    "written", [{}, {"order": ">"}, {"height": PROFILER.columns}, {"padding": 12}], ids=lambda each: str(each)
)
def test_point_clouds_of_ros_2(tmp_path: Path, written: dict[str, Any]) -> None:
    path = write_clouds(tmp_path / "scan.mcap", *(cloud(n, **written) for n in range(3)))
    found = read(path, *M, "axes=x,y,z", "sigma=y")
    assert len(found) == 3
    for n, profile in enumerate(found):
        np.testing.assert_allclose(profile.z_mm, heights_mm(n), atol=1e-5)
        known = np.isfinite(profile.z_mm)
        np.testing.assert_array_equal(profile.intensity[known], 100 + n)
        np.testing.assert_allclose(profile.sigma_mm[known], 7000.0)
        assert profile.time_s == pytest.approx(1_700_000_000 + 0.1 * n, abs=1e-6)


def test_a_file_of_ros_2_becomes_a_recording_at_its_stamps(tmp_path: Path) -> None:
    path = write_clouds(tmp_path / "scan.mcap", *(cloud(n) for n in range(3)))
    (tmp_path / "recording.toml").write_text(profiler_setup(20, 0.5))
    rows = "".join(f"{1_700_000_000 + 0.1 * n:.1f},{n},0,0,0,0,0,1\n" for n in range(-1, 5))
    (tmp_path / "poses.csv").write_text("timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n" + rows)
    options = [word for option in (*M, "axes=x,y,z") for word in ("--profile", option)]
    files = ("--setup", tmp_path / "recording.toml", "--poses", tmp_path / "poses.csv")
    run("import", path, *files, *options, "--out", tmp_path / "made")
    assert [row.timestamp_s for row in read_recording(tmp_path / "made").rows] == pytest.approx(
        [1_700_000_000 + 0.1 * n for n in range(3)], abs=1e-6
    )
    path = write_clouds(tmp_path / "twice.mcap", cloud(1), cloud(1))
    refused = RUNNER.invoke(app, ["import", *map(str, (path, *files, *options, "--out", tmp_path / "no"))])
    assert "twice.mcap: the time of profile 2 does not come after" in str(refused.exception)
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("missing", ["up_mm", "across_mm", "axes"])
def test_what_ros_2_does_not_say_is_asked_for(tmp_path: Path, missing: str) -> None:
    path = write_clouds(tmp_path / "scan.mcap", cloud(0))
    options = [option for option in (*M, "axes=x,y,z") if not option.startswith(missing)]
    with pytest.raises(ArctrackError, match=rf"scan.mcap: .*--profile {missing}="):
        read(path, *options)


def test_topics_are_named(tmp_path: Path) -> None:
    path = write_clouds(tmp_path / "scan.mcap", cloud(0), topics=("/left", "/right"))
    for options, problem in (((), "several topics"), (("topic=/middle",), "no point clouds of /middle")):
        with pytest.raises(
            ArctrackError, match=rf"mcap: has {problem}.*--profile topic= one of /left, /right"
        ):
            read(path, *M, "axes=x,y,z", *options)
    assert len(read(path, *M, "axes=x,y,z", "topic=/right")) == 1
    with pytest.raises(ArctrackError, match="axes=x,y,w: must be three of x, y, z, intensity"):
        read(path, *M, "axes=x,y,w", "topic=/left")


def test_rows_of_points_are_no_profile(tmp_path: Path) -> None:
    path = write_clouds(tmp_path / "scan.mcap", cloud(0), cloud(0, height=2))
    with pytest.raises(ArctrackError, match=r"scan.mcap: message 2 of topic /scan: holds 2 rows"):
        read(path, *M, "axes=x,y,z")


def foxglove_file(frame: str, pose: dict[str, Any] | None, is_own: bool) -> bytes:
    file = io.BytesIO()
    writer = mcap_writer.Writer(file)
    writer.start()
    if is_own:
        writer.add_metadata("arctrack", {"seconds_later": "2"})
    schema = writer.register_schema("foxglove.PointCloud", "jsonschema", b"{}")
    channel = writer.register_channel("/profile", "json", schema)
    message = {
        "timestamp": {"sec": 5, "nsec": 0},
        "frame_id": frame,
        "point_stride": 12,
        "fields": [{"name": name, "offset": 4 * n, "type": FLOAT32} for n, name in enumerate("xyz")],
        "data": "",
    }
    writer.add_message(channel, 0, json.dumps(message | ({"pose": pose} if pose else {})).encode(), 0)
    writer.finish()
    return file.getvalue()


def test_what_was_read_in_images_is_no_profilers(tmp_path: Path) -> None:
    path = tmp_path / "replay.mcap"
    path.write_bytes(foxglove_file("tool", None, is_own=True))
    with pytest.raises(ArctrackError, match=r"replay.mcap: topic /profile .*import the images instead"):
        read(path, "layout=mcap")


def test_a_pose_of_the_points_is_refused(tmp_path: Path) -> None:
    path, turn = tmp_path / "fox.mcap", {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    path.write_bytes(
        foxglove_file("laser", {"position": {"x": 1.0, "y": 0.0, "z": 0.0}, "orientation": turn}, False)
    )
    with pytest.raises(ArctrackError, match="message 1 of topic /profile: its points have a pose"):
        read(path, *M, "axes=x,y,z")


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7, 0.999])
def test_of_a_file_that_was_broken_off_what_is_whole_is_read(tmp_path: Path, share: float) -> None:
    path = write_clouds(tmp_path / "run.mcap", *(cloud(n % 8) for n in range(40)), chunk_bytes=2000)
    whole, content = read(path, *M, "axes=x,y,z"), path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    left = read(path, *M, "axes=x,y,z")
    assert 0.5 * share * len(whole) < len(left) <= len(whole)
    for ours, theirs in zip(left, whole, strict=False):
        np.testing.assert_array_equal(ours.z_mm, theirs.z_mm)
        assert ours.time_s == theirs.time_s


@pytest.mark.parametrize("damage", ["empty", "text", "cut", "flipped", "gone"])
def test_damaged_files_are_a_line(tmp_path: Path, damage: str) -> None:
    path = write_clouds(tmp_path / "scan.mcap", *(cloud(n) for n in range(20)))
    whole = path.read_bytes()
    spoilt = {
        "empty": b"",
        "text": b"x,y,z\n1,2,3\n",
        "cut": whole[: len(whole) // 2],
        "flipped": whole[:300] + struct.pack("<16B", *range(16)) + whole[316:],
    }
    path.unlink()
    if damage in spoilt:
        path.write_bytes(spoilt[damage])
    with pytest.raises(ArctrackError, match=r"scan.mcap: ") as caught:
        read(path, *M, "axes=x,y,z")
    assert "\n" not in str(caught.value)


def test_a_file_without_point_clouds_says_what_is_read(tmp_path: Path) -> None:
    with (tmp_path / "none.mcap").open("wb") as file:
        writer = mcap_writer.Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(ArctrackError, match=r"none.mcap: has no topic of point clouds that are read"):
        read(tmp_path / "none.mcap", *M)
