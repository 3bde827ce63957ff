"""replay.mcap, read back by MCAP's own reader."""

import base64
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import UNREADABLE, assert_cell, results_of
from PIL import Image
from scipy.spatial.transform import Rotation

from arctrack.recording import BadFrame, read_recording
from arctrack.recording.results import REPLAY_MCAP
from arctrack.replay.replay import Replay, ReplayOptions, replay_recording
from arctrack.report.image import visible

mcap_reader = pytest.importorskip("mcap.reader")


def replay_with(path: Path, folder: Path) -> Replay:
    options = ReplayOptions(pictures=False, exports=(REPLAY_MCAP,))
    return replay_recording(read_recording(path), folder, options)


@pytest.fixture(scope="module")
def done(flawed_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    return replay_with(flawed_recording, tmp_path_factory.mktemp("mcap"))


def log_time_ns(time_s: float) -> int:
    """Return when something of the recording is logged: it begins before 0, the file a second later."""
    return round((time_s + 1.0) * 1e9)


def messages(done: Replay, topic: str) -> list[tuple[int, dict[str, Any]]]:
    """Return the log times, ns, and the messages of a topic, in order."""
    with (done.folder / REPLAY_MCAP).open("rb") as file:
        reader = mcap_reader.make_reader(file, validate_crcs=True)
        return [
            (message.log_time, json.loads(message.data))
            for _, _, message in reader.iter_messages(topics=[topic])
        ]


def test_counts_times_and_values_are_those_of_the_results(done: Replay) -> None:
    rows = results_of(done.folder)
    tracks = messages(done, "/track")
    assert [ns for ns, _ in tracks] == [log_time_ns(float(row["timestamp_s"])) for row in rows]
    for (_, track), row in zip(tracks, rows, strict=True):
        assert track["frame"] == int(row["frame"])
        assert track["valid"] == (row["valid"] == "1")
        assert "|".join(track["flags"]) == row["flags"]
        assert track["time_s"] == pytest.approx(float(row["timestamp_s"]), abs=1e-6)
        for name in ("seam_x_mm", "seam_y_mm", "sigma_z_mm", "offset_y_mm", "gap_mm", "confidence"):
            assert_cell(track.get(name), row[name])
        assert (track["bus"] == "none") == (row["offset_y_mm"] == "")
    checks = [check for check in tracks[8][1]["checks"] if check["outcome"] != "passed"]
    assert {check["flag"] for check in checks} == set(tracks[8][1]["flags"])
    assert tracks[UNREADABLE][1]["checks"] == []


def test_the_summary_counts_every_topic(done: Replay, flawed_recording: Path) -> None:
    with (done.folder / REPLAY_MCAP).open("rb") as file:
        reader = mcap_reader.make_reader(file)
        summary = reader.get_summary()
        attachments = list(reader.iter_attachments())
        metadata = list(reader.iter_metadata())
    counts = {
        channel.topic: summary.statistics.channel_message_counts[number]
        for number, channel in summary.channels.items()
    }
    readable = len(done.tracks) - 1
    assert counts == {
        "/track": len(done.tracks),
        "/camera/image": readable,
        "/camera/arc_map": readable,
        "/camera/annotations": readable,
        "/camera/calibration": 1,
        "/tf": readable + 1,
        "/profile": sum(track.valid for track in done.tracks),
    }
    (attachment,) = attachments
    assert attachment.name == "recording.toml"
    assert attachment.data == (flawed_recording / "recording.toml").read_bytes()
    assert metadata[0].metadata == {"recording": "r", "seconds_later": "1"}


def test_messages_keep_to_their_schemas(done: Replay) -> None:
    seen = set()
    with (done.folder / REPLAY_MCAP).open("rb") as file:
        for schema, channel, message in mcap_reader.make_reader(file).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert_fits(json.loads(message.data), json.loads(schema.data), channel.topic)
            seen.add(schema.name)
    assert "arctrack.Track" in seen
    assert {name for name in seen if name.startswith("foxglove.")} == seen - {"arctrack.Track"}


def test_pictures_are_the_frames(done: Replay) -> None:
    recording = done.recording
    images = dict(messages(done, "/camera/image"))
    for frame, row in zip(recording.frames(), recording.rows, strict=True):
        ns = log_time_ns(row.timestamp_s)
        assert (ns in images) == (row.index != UNREADABLE)
        if isinstance(frame, BadFrame):
            continue
        assert images[ns]["format"] == "jpeg"
        assert images[ns]["timestamp"] == {"sec": ns // 10**9, "nsec": ns % 10**9}
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(images[ns]["data"]))), dtype=float)
        grey = visible(frame.image_dn, recording.setup.sensor)
        assert picture.shape == grey.shape
        # What JPEG loses of the noise is not seen in means over its blocks.
        height, width = grey.shape
        apart = (picture - grey).reshape(height // 8, 8, width // 8, 8).mean(axis=(1, 3))
        assert np.abs(apart).max() < 3.0


def test_the_profile_runs_through_the_seam_and_the_annotations_cross_it(done: Replay) -> None:
    tracks = dict(messages(done, "/track"))
    for ns, cloud in messages(done, "/profile"):
        assert (cloud["frame_id"], cloud["point_stride"]) == ("tool", 12)
        points_mm = 1e3 * np.frombuffer(base64.b64decode(cloud["data"]), dtype="<f4").reshape(-1, 3)
        track = tracks[ns]
        assert points_mm[:, 1].min() < track["seam_y_mm"] < points_mm[:, 1].max()
        near = np.abs(points_mm[:, 1] - track["seam_y_mm"]) < 1.0
        assert np.abs(points_mm[near, 2] - track["seam_z_mm"]).min() < 0.5
    for ns, annotations in messages(done, "/camera/annotations"):
        if not tracks[ns]["valid"]:
            continue
        ring = annotations["circles"][0]
        stripe = np.array([[p["x"], p["y"]] for line in annotations["points"] for p in line["points"]])
        apart = stripe - [ring["position"]["x"], ring["position"]["y"]]
        assert np.hypot(*apart.T).min() < 4.0


def test_the_poses_are_the_recordings(done: Replay) -> None:
    recording, poses = done.recording, done.recording.pose_buffer()
    moved = [(ns, each) for ns, each in messages(done, "/tf") if each["child_frame_id"] == "tool"]
    rows = [row for row in recording.rows if row.index != UNREADABLE]
    for (_, transform), row in zip(moved, rows, strict=True):
        pose = recording.pose_at(poses, row.timestamp_s)
        assert pose is not None
        t, q = transform["translation"], transform["rotation"]
        np.testing.assert_allclose([t["x"], t["y"], t["z"]], 1e-3 * pose.T_base_tool[:3, 3], atol=1e-9)
        R = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix()
        np.testing.assert_allclose(R, pose.T_base_tool[:3, :3], atol=1e-9)


def assert_fits(value: Any, schema: dict[str, Any], place: str) -> None:
    """Hold a value against a JSON schema of the few kinds that are used, no key unknown to it."""
    match schema["type"]:
        case "object":
            assert isinstance(value, dict), place
            for name, item in value.items():
                assert_fits(item, schema["properties"][name], f"{place}.{name}")
        case "array":
            assert isinstance(value, list), place
            for item in value:
                assert_fits(item, schema["items"], f"{place}[]")
        case "string":
            assert isinstance(value, str), place
            if schema.get("contentEncoding") == "base64":
                base64.b64decode(value, validate=True)
        case "boolean":
            assert isinstance(value, bool), place
        case "integer":
            assert isinstance(value, int), place
        case kind:
            assert kind == "number"
            assert isinstance(value, int | float), place
            assert math.isfinite(value), place
