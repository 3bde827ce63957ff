import math
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import av
import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made import HEIGHT, WIDTH, level_pose, noise_frames, replace_in, small_setup, write

from arctrack.errors import ArctrackError
from arctrack.nominal import nominal_setup
from arctrack.recording import (
    BadFrame,
    PoseTable,
    RecordingWriter,
    VideoFormat,
    format_setup,
    pose_at,
    read_recording,
    read_setup_file,
    read_truth,
    with_camera_pose,
)
from arctrack.recording.ffv1 import checksums_hold, index_of, read_video
from arctrack.recording.png import decode, encode, header_of, problem_of
from arctrack.recording.poses import runs_against_travel
from arctrack.recording.setup_file import parse_setup
from arctrack.recording.tables import read_frame_rows, read_poses_csv
from noise_model.effects import checked
from noise_model.setup import Setup
from robot_io import BusLogWriter, PoseKind, Protector, RobotPosePosition, RobotPoseRotation


def same_setup(a: Setup, b: Setup) -> bool:
    plain_a, plain_b = (replace(s, camera=replace(s.camera, T_tool_camera=np.eye(4))) for s in (a, b))
    return np.allclose(a.camera.T_tool_camera, b.camera.T_tool_camera, atol=1e-12) and repr(plain_a) == repr(
        plain_b
    )


def complaint_of(function: Callable[..., object], *arguments: object) -> str | None:
    """Return the text of the ArctrackError that a call raises, if it does."""
    try:
        function(*arguments)
    except ArctrackError as error:
        return str(error)
    return None


@pytest.mark.parametrize("bits", [8, 10, 16])
@pytest.mark.parametrize("video", [None, VideoFormat(rate_hz=10.0)])
def test_what_was_written_is_read_bit_for_bit(tmp_path: Path, bits: int, video: VideoFormat | None) -> None:
    setup = small_setup(bits)
    frames = noise_frames(setup, 6)
    recording = read_recording(write(tmp_path / "r", setup, frames, video=video))
    assert same_setup(recording.setup, setup)
    assert recording.warnings == ()
    for _ in range(2):
        read = list(recording.frames())
        for frame, written in zip(read, frames, strict=True):
            assert not isinstance(frame, BadFrame), frame.message
            assert frame.image_dn.dtype == written.image_dn.dtype
            np.testing.assert_array_equal(frame.image_dn, written.image_dn)
            assert repr(replace(frame, timestamp_s=0.0)) == repr(replace(written, timestamp_s=0.0))
            assert frame.timestamp_s == pytest.approx(written.timestamp_s)


@pytest.mark.parametrize("video", [None, VideoFormat(rate_hz=10.0)])
def test_chosen_frames_are_the_same_ones(tmp_path: Path, video: VideoFormat | None) -> None:
    setup = small_setup()
    recording = read_recording(write(tmp_path / "r", setup, noise_frames(setup, 6), video=video))
    whole = list(recording.frames())
    for n, frame in zip([1, 4, 5], recording.frames([1, 4, 5]), strict=True):
        expected = whole[n]
        assert not isinstance(frame, BadFrame)
        assert not isinstance(expected, BadFrame)
        assert frame.index == n
        np.testing.assert_array_equal(frame.image_dn, expected.image_dn)


def test_setup_text_comes_back(tmp_path: Path) -> None:
    setup = replace(
        small_setup(),
        effects={"veiling_glare": {"share": 0.2, "spread": 0.5}, "gamma": {"gamma": 0.7, "bend": 0.1}},
    )
    text = format_setup(setup)
    stated = parse_setup(text + "\n[robot]\neuler_order = 'zyx'\n", tmp_path / "recording.toml")
    assert same_setup(stated.setup, setup)
    assert stated.setup.effects == setup.effects
    assert stated.robot == {"euler_order": "zyx"}
    # Poses are quaternions: whoever states an order must hear that nothing is done with it.
    assert stated.unknown_keys == ("[robot] euler_order",)
    assert format_setup(stated.setup) == text


def test_what_a_camera_has_derived_is_no_part_of_its_setup() -> None:
    fresh, used = small_setup(), small_setup()
    assert used.camera.intrinsics.fx == used.camera.fx
    assert format_setup(used) == format_setup(fresh)


def test_a_misspelt_tool_frame_is_reported(tmp_path: Path) -> None:
    pose = "translation_mm = [1.0, 2.0, 3.0]\nquaternion_xyzw = [1.0, 0.0, 0.0, 0.0]\n"
    text = format_setup(small_setup()) + f"[robot.controller_tool_to_tool]\n{pose}"
    stated = parse_setup(text, tmp_path / "recording.toml")
    assert stated.T_tool_controllertool is None
    assert stated.unknown_keys == ("[robot] controller_tool_to_tool",)


def test_effects_of_other_tools_are_kept_whatever_they_hold(tmp_path: Path) -> None:
    text = (
        format_setup(small_setup())
        + '[effects]\nremark = "by hand"\n[effects.my_own]\npoints = [1.0, 2.0]\nenabled = true\n'
        + '[effects.fume]\nnote = "seen on monday"\n'
    )
    stated = parse_setup(text, tmp_path / "recording.toml")
    assert stated.unknown_keys == ("[effects] remark", "[effects.my_own]", "[effects.fume] note")
    assert set(stated.setup.effects) == {"fume"}


def test_unknown_effects_and_parameters_are_reported(tmp_path: Path) -> None:
    text = (
        format_setup(small_setup()) + "[effects.moonlight]\nglow = 1\n[effects.spatter]\nrate_per_frame = 2\n"
    )
    stated = parse_setup(text + "colour = 3\n", tmp_path / "recording.toml")
    assert stated.unknown_keys == ("[effects.moonlight]", "[effects.spatter] colour")
    # What the file does not say of an effect is the effect's own prior.
    assert stated.setup.effects == checked({"spatter": {"rate_per_frame": 2.0}})


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ("[effects.gamma]\ngamma = 0.0\n", r"\[effects.gamma\] gamma = 0: must lie from 0.2 to 5"),
        ("[effects.gamma]\ngamma = 'low'\n", r"\[effects.gamma\] gamma = 'low'"),
        ("[effects.gamma]\ngamma = nan\n", r"\[effects.gamma\] gamma = nan: must be a finite number"),
        ("[effects.gamma]\ngamma = true\n", r"\[effects.gamma\] gamma = True: must be a finite number"),
        ("[effects]\ngamma = 1.2\n", r"\[effects\] gamma = 1.2: must be a table"),
    ],
)
def test_an_effect_that_cannot_be_is_refused(tmp_path: Path, table: str, named: str) -> None:
    with pytest.raises(ArctrackError, match=f"recording.toml: {named}"):
        parse_setup(format_setup(small_setup()) + table, tmp_path / "recording.toml")


def test_what_bounces_in_a_u_is_refused(tmp_path: Path) -> None:
    text = format_setup(nominal_setup("u_groove", "mild_steel")) + "[effects.interreflection]\n"
    with pytest.raises(ArctrackError, match=r"recording.toml: \[effects.interreflection\]: is not predicted"):
        parse_setup(text, tmp_path / "recording.toml")


def test_a_fillet_may_state_a_gap(tmp_path: Path) -> None:
    text = format_setup(nominal_setup("fillet", "mild_steel"))
    stated = parse_setup(
        text.replace('type = "fillet"', 'type = "fillet"\ngap_mm = 1.5'), tmp_path / "r.toml"
    )
    assert stated.unknown_keys == ()
    assert stated.setup.joint.dimensions == {"included_angle_deg": 90.0, "gap_mm": 1.5}
    assert "gap_mm" not in parse_setup(text, tmp_path / "r.toml").setup.joint.dimensions


def test_unknown_keys_are_kept_and_reported(tmp_path: Path) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 3))
    replace_in(path / "recording.toml", "gamma = 1.0", "gamma = 1.0\ncolour = 'grey'")
    with (path / "recording.toml").open("a") as file:
        file.write("wobble_mm = 1.0\n\n[operator]\nname = 'somebody'\n")
    text = (path / "frames.csv").read_text().splitlines()
    (path / "frames.csv").write_text("\n".join([text[0] + ",mood", *(line + ",good" for line in text[1:])]))
    recording = read_recording(path)
    assert recording.unknown_keys == ("[operator]", "[sensor] colour", "[joint] wobble_mm")
    assert len(recording.warnings) == 4
    assert "the column mood" in recording.warnings[3]


@pytest.mark.parametrize("units", ["mm, s, deg, e-, DN", "mm,s", "DN", "mm, s, A, nm, px"])
def test_units_that_are_the_recordings_own(tmp_path: Path, units: str) -> None:
    text = format_setup(small_setup()).replace("mm, s, deg, e-, DN", units)
    assert parse_setup(text, tmp_path / "recording.toml").unknown_keys == ()


def test_a_byte_order_mark_is_no_part_of_the_setup(tmp_path: Path) -> None:
    setup = small_setup()
    path = tmp_path / "recording.toml"
    path.write_text(format_setup(setup), encoding="utf-8-sig")
    assert path.read_bytes().startswith(b"\xef\xbb\xbf")
    assert same_setup(read_setup_file(path).setup, setup)
    assert same_setup(parse_setup(with_camera_pose(path, setup.camera.T_tool_camera), path).setup, setup)


def test_a_folder_is_no_log(tmp_path: Path) -> None:
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 3))
    (path / "poses.csv").unlink()
    (path / "can.log").mkdir()
    with pytest.raises(ArctrackError, match=r"can\.log: is a folder: a regular file is needed"):
        read_recording(path)


REVERSED = ("[[-100.0, 0.0, 0.0], [1000.0, 0.0, 0.0]]", "[[1000.0, 0.0, 0.0], [-100.0, 0.0, 0.0]]")


def test_a_line_that_runs_against_the_travel_is_refused(tmp_path: Path) -> None:
    # 8 mm/s, a frame each 0.1 s.
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 9))
    read_recording(path)
    replace_in(path / "recording.toml", *REVERSED)
    with pytest.raises(
        ArctrackError,
        match=r"recording\.toml: \[joint\] seam_in_base_mm: runs against the travel; reverse its points",
    ):
        read_recording(path)


def test_where_the_tool_hardly_moves_no_line_runs_against_the_travel(tmp_path: Path) -> None:
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 4))
    replace_in(path / "recording.toml", *REVERSED)
    read_recording(path)


def test_the_nearest_segment_says_where_the_travel_goes(tmp_path: Path) -> None:
    """A weld around three sides of a square."""
    corners = [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (20.0, 20.0, 0.0), (0.0, 20.0, 0.0)]
    joint = replace(small_setup().joint, seam_in_base_mm=tuple(corners))
    path_mm = (
        [(x, 0.0) for x in range(20)] + [(20.0, y) for y in range(20)] + [(20.0 - x, 20.0) for x in range(20)]
    )
    T_base_tool = np.tile(np.eye(4), (len(path_mm), 1, 1))
    T_base_tool[:, :2, 3] = path_mm
    times_s = np.arange(len(path_mm)) / 10.0
    poses = PoseTable(tmp_path / "poses.csv", times_s, T_base_tool)
    assert not runs_against_travel(poses, times_s.tolist(), joint)
    backwards = replace(poses, T_base_tool=T_base_tool[::-1])
    assert runs_against_travel(backwards, times_s.tolist(), joint)
    # One wild pose at the end is no travel.
    wild = T_base_tool.copy()
    wild[-1, 0, 3] = 1000.0
    assert not runs_against_travel(replace(poses, T_base_tool=wild), times_s.tolist(), joint)


def test_controller_with_its_own_tool_frame(tmp_path: Path) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 3))
    plain = read_recording(path).poses.T_base_tool
    with (path / "recording.toml").open("a") as file:
        file.write("\n[robot.controllertool_to_tool]\n")
        file.write("translation_mm = [0, 0, 0]\nquaternion_xyzw = [1, 0, 0, 0]\n")
    turned = read_recording(path).poses.T_base_tool
    # The controller's z points into the work: half a turn about x brings it to ours.
    np.testing.assert_allclose(turned, plain @ np.diag([1.0, -1.0, -1.0, 1.0]), atol=1e-12)


def test_poses_of_a_can_log(tmp_path: Path) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 3))
    expected = read_recording(path).poses
    (path / "poses.csv").unlink()
    protector = Protector()
    with BusLogWriter(path / "can.blf") as log:
        log.write(can.Message(timestamp=0.0, arbitration_id=0x7E0, is_extended_id=False, data=b"foreign"))
        for timestamp_s, T_base_tool in zip(expected.timestamps_s, expected.T_base_tool, strict=True):
            _log_pose(log, protector, float(timestamp_s) + 1.0, T_base_tool[:3, 3])
    _delay_frames(path / "frames.csv")
    recording = read_recording(path)
    assert "1 frames of the bus were left out" in recording.warnings[0]
    np.testing.assert_allclose(recording.poses.timestamps_s, expected.timestamps_s + 1.0, atol=1e-6)
    np.testing.assert_allclose(recording.poses.T_base_tool, expected.T_base_tool, atol=0.01)
    pose = pose_at(recording.pose_buffer(), 1.1)
    assert pose is not None
    np.testing.assert_allclose(pose.T_base_tool, level_pose(0.1), atol=0.01)


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_a_spreadsheet_may_have_saved_the_tables(separator: str, tmp_path: Path) -> None:
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 3))
    expected = read_recording(path)
    for name in ("frames.csv", "poses.csv"):
        text = (path / name).read_text()
        (path / name).write_text(text.replace(",", separator).replace(".", ","))
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.poses.T_base_tool, expected.poses.T_base_tool)
    assert recording.rows == expected.rows


def test_poses_that_are_logged_twice_are_taken_once(tmp_path: Path) -> None:
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 3))
    expected = read_recording(path).poses
    rows = _lines(path / "poses.csv")
    (path / "poses.csv").write_text("\n".join([_header(path / "poses.csv"), rows[0], *rows, rows[-1]]))
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.poses.timestamps_s, expected.timestamps_s)
    assert f"{path / 'poses.csv'}: 2 rows repeat the row before: they are left out" in recording.warnings


@pytest.fixture
def logged(tmp_path: Path) -> Path:
    """A recording whose poses are in the log of two buses, `can.asc`: the second's robot is 30 mm beside."""
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 3))
    (path / "poses.csv").unlink()
    lines = []
    for channel in (1, 2):
        protector = Protector()
        for n in range(-10, 40):
            for message in (
                RobotPosePosition(0.1 * n, 30.0 * (channel - 1), 0.0, kind=PoseKind.ACTUAL),
                RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), sample_age_ms=0.0),
            ):
                number, payload = protector.protect(message)
                lines.append(f"{1.0 + 0.01 * n:.6f} {channel} {number:x} Rx d 8 {payload.hex(' ')}\n")
    (path / "can.asc").write_text(f"base hex  timestamps absolute\n{''.join(sorted(lines))}")
    _delay_frames(path / "frames.csv")
    return path


def test_of_two_robots_in_a_log_the_setup_names_one(logged: Path) -> None:
    with pytest.raises(
        ArctrackError, match=r"can\.asc: the channels 1 and 2 both carry RobotPosePosition; name"
    ) as refused:
        read_recording(logged)
    assert str(refused.value).endswith("name the robot's by [robot] can_channel in recording.toml")
    setup = (logged / "recording.toml").read_text()
    for channel, y_mm in ((1, 0.0), ('"2"', 30.0)):
        (logged / "recording.toml").write_text(f"{setup}\n[robot]\ncan_channel = {channel}\n")
        recording = read_recording(logged)
        assert not recording.unknown_keys
        assert set(recording.poses.T_base_tool[:, 1, 3]) == {y_mm}
        assert len(recording.poses.timestamps_s) == 50


def test_a_log_that_is_cut_says_so_in_the_place_of_other_causes(logged: Path) -> None:
    log = logged / "can.asc"
    lines = [line for line in log.read_text().splitlines(keepends=True) if " 2 1" not in line]
    log.write_text("".join(lines)[:-30])
    assert (
        f"{log}: is cut off in line {len(lines)}: what stands before it is read"
        in read_recording(logged).warnings
    )
    log.write_text("".join(lines[:13]) + lines[13][:20])
    with pytest.raises(ArctrackError, match=r"stop before the frames: .* is cut off in line 14"):
        read_recording(logged)
    log.write_text(lines[0] + lines[1][:20])
    with pytest.raises(ArctrackError, match=r"no whole pose of arctrack\.dbc; is cut off in line 2"):
        read_recording(logged)


def test_an_asc_of_another_time_zone_is_told_from_poses_that_stop(
    logged: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = logged / "can.asc"
    lines = [line for line in log.read_text().splitlines(keepends=True) if " 2 1" not in line]
    log.write_text("".join(["date Wed May 1 10:00:00.000 2024\n", *lines]))
    frames = [
        f"{line[0]},{1_714_557_600.0 + float(line[2:10]):.6f}{line[10:]}"
        for line in _lines(logged / "frames.csv")
    ]
    (logged / "frames.csv").write_text("\n".join([_header(logged / "frames.csv"), *frames]))
    for zone, problem in (("UTC", None), ("Asia/Tokyo", "stop before"), ("America/New_York", "start after")):
        monkeypatch.setenv("TZ", zone)
        time.tzset()
        if problem is None:
            assert len(read_recording(logged).poses.timestamps_s) == 50
        else:
            with pytest.raises(ArctrackError, match=f"{problem} the frames: .* set TZ to the time zone"):
                read_recording(logged)
    monkeypatch.undo()
    time.tzset()


def test_a_controller_that_sends_a_sample_twice_is_heard_once(tmp_path: Path) -> None:
    """Pose frames every 10 ms of samples every 20 ms: their ages are 0, 10, 0 ... ms, a clock's tick off."""
    path = write(tmp_path / "r", small_setup(), noise_frames(small_setup(), 3))
    (path / "poses.csv").unlink()
    protector, expected = Protector(), []
    with BusLogWriter(path / "can.blf") as log:
        for n in range(-20, 60):
            sampled_s, age_s = 0.02 * (n // 2), 0.01 * (n % 2)
            if n % 2 == 0:
                expected.append(sampled_s)
            sent_at_s = 1.0 + sampled_s + age_s - (1e-4 if age_s else 0.0)
            _log_pose(log, protector, sent_at_s, (1e3 * sampled_s, 0.0, 0.0), 1e3 * age_s)
    _delay_frames(path / "frames.csv")
    recording = read_recording(path)
    assert "40 frames of the bus were left out" in recording.warnings[0]
    np.testing.assert_allclose(recording.poses.timestamps_s, np.array(expected) + 1.0, atol=1e-6)


def _log_pose(
    log: BusLogWriter,
    protector: Protector,
    sent_at_s: float,
    position_mm: Iterable[float],
    sample_age_ms: float = 0.0,
) -> None:
    """Write the two frames of an upright tool's pose."""
    x, y, z = (float(value) for value in position_mm)
    for message in (
        RobotPosePosition(x, y, z, kind=PoseKind.ACTUAL),
        RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), sample_age_ms=sample_age_ms),
    ):
        identifier, payload = protector.protect(message)
        log.write(
            can.Message(timestamp=sent_at_s, arbitration_id=identifier, is_extended_id=False, data=payload)
        )


def _delay_frames(frames_csv: Path) -> None:
    """Put all frames of a recording a second later, where a bus' poses may begin before them."""
    later = [f"{line[0]},{float(line[2:10]) + 1.0:.6f}{line[10:]}" for line in _lines(frames_csv)]
    frames_csv.write_text("\n".join([_header(frames_csv), *later]))


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines()[1:]


def _header(path: Path) -> str:
    return path.read_text().splitlines()[0]


def test_truth_is_read_by_its_own_function_alone(tmp_path: Path) -> None:
    setup = small_setup()
    with RecordingWriter(tmp_path / "r", setup) as writer:
        for frame in noise_frames(setup, 2):
            writer.write_frame(frame)
            writer.write_truth(frame.index, np.array([35.0, 0.1, -0.2]))
        for timestamp_s in (-0.1, 0.0, 0.1, 0.2):
            writer.write_pose(timestamp_s, level_pose(timestamp_s))
    truth = read_truth(tmp_path / "r")
    assert truth is not None
    np.testing.assert_allclose(truth.seam_tool_mm, [[35.0, 0.1, -0.2]] * 2)
    (tmp_path / "r" / "truth.csv").write_text("not for those who track")
    assert len(list(read_recording(tmp_path / "r").frames())) == 2
    (tmp_path / "r" / "truth.csv").unlink()
    assert read_truth(tmp_path / "r") is None


def test_a_recording_cut_short_says_so(tmp_path: Path) -> None:
    setup = small_setup()
    frames = noise_frames(setup, 3)

    def cut_short() -> None:
        with RecordingWriter(tmp_path / "r", setup) as writer:
            for timestamp_s in (-0.1, 0.0, 0.1, 0.2, 0.3):
                writer.write_pose(timestamp_s, level_pose(timestamp_s))
            writer.write_frame(frames[0])
            writer.write_frame(frames[1])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut_short()
    assert not (tmp_path / "r").exists()
    with pytest.raises(ArctrackError, match=r"r\.unfinished: was not written to its end"):
        read_recording(tmp_path / "r.unfinished")
    with pytest.raises(ArctrackError, match="exists already"):
        RecordingWriter(tmp_path / "r", setup)
    (tmp_path / "r.unfinished").rename(tmp_path / "kept")
    assert len(list(read_recording(tmp_path / "kept").frames())) == 2


def test_bad_pngs_in_the_middle_do_not_stop_the_reading(tmp_path: Path) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 8)) / "frames"
    whole = (path / "000001.png").read_bytes()
    (path / "000001.png").write_bytes(whole[: len(whole) // 2])
    (path / "000002.png").write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])
    (path / "000003.png").write_bytes(b"")
    (path / "000004.png").unlink()
    (path / "000005.png").write_bytes(encode(np.zeros((HEIGHT, WIDTH + 1), np.uint8)))
    (path / "000006.png").write_bytes(encode(np.zeros((HEIGHT, WIDTH), np.uint16)))
    (path / "000007.png").write_bytes(encode(np.zeros((HEIGHT, WIDTH, 3), np.uint8)))
    first, *bad = read_recording(tmp_path / "r").frames()
    assert not isinstance(first, BadFrame)
    expected = ["truncated", "damaged", "empty", "no such file", "49 x 36", "16 bits", "3 channels"]
    for n, (frame, problem) in enumerate(zip(bad, expected, strict=True), start=1):
        assert isinstance(frame, BadFrame)
        assert problem in frame.message
        assert f"00000{n}.png" in frame.message


def test_bad_video_frames_do_not_stop_the_reading(tmp_path: Path) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 8), video=VideoFormat(10.0)) / "frames.mkv"
    whole = bytearray(path.read_bytes())
    whole[len(whole) * 55 // 100] ^= 0xFF
    path.write_bytes(whole[: len(whole) * 80 // 100])
    good = {f.index for f in read_recording(tmp_path / "r").frames() if not isinstance(f, BadFrame)}
    bad = [f for f in read_recording(tmp_path / "r").frames() if isinstance(f, BadFrame)]
    assert good == {0, 1, 2, 3, 5}
    assert "frame 4 of the video is damaged" in bad[0].message
    assert "the video ends after 6 frames" in bad[-1].message


def test_video_with_more_frames_than_rows(tmp_path: Path) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 4), video=VideoFormat(10.0))
    lines = (path / "frames.csv").read_text().splitlines()
    (path / "frames.csv").write_text("\n".join(lines[:-1]))
    assert len(index_of(path / "frames.mkv")) == 4
    with pytest.raises(ArctrackError, match=r"frames\.mkv: holds 4 frames where frames\.csv has 3 rows"):
        read_recording(path)


@pytest.mark.parametrize("where", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("bad", [0, 4])
def test_a_damaged_frame_is_found_wherever_a_pass_begins(tmp_path: Path, bad: int, where: float) -> None:
    setup = small_setup()
    path = write(tmp_path / "r", setup, noise_frames(setup, 6), video=VideoFormat(10.0)) / "frames.mkv"
    with av.open(str(path)) as video:
        packet = [bytes(packet) for packet in video.demux(video=0) if packet.size][bad]
    whole = bytearray(path.read_bytes())
    whole[whole.index(packet) + int(where * len(packet))] ^= 0x55
    path.write_bytes(whole)
    recording = read_recording(tmp_path / "r")
    assert recording.warnings == ()
    assert [n for n, frame in enumerate(recording.frames()) if isinstance(frame, BadFrame)] == [bad]
    (alone,) = recording.frames([bad])
    assert isinstance(alone, BadFrame)
    assert f"frame {bad} of the video is damaged" in alone.message


def test_a_video_without_checksums_is_read_with_a_warning(tmp_path: Path) -> None:
    setup = small_setup()
    frames = noise_frames(setup, 3)
    path = write(tmp_path / "r", setup, frames, video=VideoFormat(10.0)) / "frames.mkv"
    with av.open(str(path), mode="w") as video:
        stream = video.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        stream.options = {"level": "3", "slicecrc": "0", "g": "1"}
        for frame in frames:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image_dn, format="gray")))
        video.mux(stream.encode())
    recording = read_recording(tmp_path / "r")
    (warning,) = recording.warnings
    assert warning.startswith(f"{path}: carries no checksums")
    for read, written in zip(recording.frames(), frames, strict=True):
        assert not isinstance(read, BadFrame), read.message
        np.testing.assert_array_equal(read.image_dn, written.image_dn)


def test_a_colon_in_a_relative_path_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    setup = small_setup()
    path = write(Path("10:30"), setup, noise_frames(setup, 2), video=VideoFormat(10.0))
    assert not any(isinstance(frame, BadFrame) for frame in read_recording(path).frames())


def test_checksums_of_a_packet() -> None:
    assert not checksums_hold(b"")
    assert not checksums_hold(bytes(range(64)))


def test_unreadable_videos(tmp_path: Path) -> None:
    (tmp_path / "no.mkv").write_bytes(b"this is no video")
    with pytest.raises(ArctrackError, match=r"no\.mkv: cannot be read as a video"):
        list(read_video(tmp_path / "no.mkv", [0]))
    with pytest.raises(ArctrackError, match=r"gone\.mkv: there is no such file"):
        list(read_video(tmp_path / "gone.mkv", [0]))


@pytest.mark.slow
@given(cut=st.integers(0, 10_000), flip=st.integers(0, 10_000))
def test_no_damage_to_a_png_goes_unnoticed(cut: int, flip: int) -> None:
    image = np.random.default_rng(1).integers(0, 65536, (12, 16)).astype(np.uint16)
    whole = encode(image)
    np.testing.assert_array_equal(decode(whole, header_of(whole)), image)
    short = whole[: cut % len(whole)]
    assert problem_of(short) is not None
    flipped = bytearray(whole)
    flipped[flip % len(whole)] ^= 0x10
    assert problem_of(bytes(flipped)) is not None
    with pytest.raises(ValueError, match="is "):
        header_of(bytes(flipped))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(alphabet="0123456789.,-+einaf\n\r\"' x_y", max_size=120), header=st.booleans())
def test_csv_parsers_answer_or_complain_but_never_break(tmp_path: Path, text: str, header: bool) -> None:
    path = tmp_path / "any.csv"
    for read, columns in (
        (read_frame_rows, "frame,timestamp_s,laser_on,arc_on,current_a,exposure_s"),
        (read_poses_csv, "timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw"),
    ):
        path.write_text((columns + "\n" if header else "") + text)
        complaint = complaint_of(read, path)
        assert complaint is None or complaint.startswith(str(path))
        assert "\n" not in (complaint or "")


@pytest.mark.slow
@given(
    old=st.sampled_from(["c2 = 112.0", "bits = 8", "fx = 164.25", "[arc]", "radius_mm = 3.0", "units ="]),
    new=st.text(alphabet="0123456789.[]{}=\"'\n -+einaftrus#", max_size=30),
)
def test_setup_parser_answers_or_complains_but_never_breaks(old: str, new: str) -> None:
    text = format_setup(small_setup())
    assert old in text
    complaint = complaint_of(parse_setup, text.replace(old, new), Path("recording.toml"))
    assert complaint is None or complaint.startswith("recording.toml: ")
    assert "\n" not in (complaint or "")


def test_conditions_compare_where_the_current_is_unknown(tmp_path: Path) -> None:
    setup = small_setup()
    rows = read_recording(write(tmp_path / "r", setup, noise_frames(setup, 6))).rows
    assert math.isnan(rows[3].current_a)
    assert rows[3].condition == replace(rows[3]).condition
    assert rows[3].condition != rows[5].condition


SHARED = Path(__file__).parents[3] / "shared" / "recordings"


@pytest.mark.skipif(not SHARED.is_dir(), reason="the shared recordings are not here")
def test_recordings_of_others_are_read_without_a_word() -> None:
    paths = sorted(path.parent for path in SHARED.glob("*/recording.toml"))
    assert paths
    for path in paths:
        recording = read_recording(path)
        assert recording.warnings == ()
        assert not any(isinstance(frame, BadFrame) for frame in recording.frames())
        assert read_truth(path) is not None
