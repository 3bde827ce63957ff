"""replay.rrd, read back by Rerun's own reader."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import UNREADABLE, assert_cell, results_of
from PIL import Image

from arctrack.recording import read_recording
from arctrack.recording.results import REPLAY_RRD
from arctrack.replay.replay import Replay, ReplayOptions, replay_recording

rerun_chunk = pytest.importorskip("rerun.chunk")


def replay_with(path: Path, folder: Path) -> Replay:
    options = ReplayOptions(pictures=False, exports=(REPLAY_RRD,))
    return replay_recording(read_recording(path), folder, options)


@pytest.fixture(scope="module")
def done(flawed_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    return replay_with(flawed_recording, tmp_path_factory.mktemp("rrd"))


def rows(done: Replay, entity: str, column: str) -> Iterator[tuple[int, float, Any]]:
    """Yield frame, time, s, and value of an entity's column, over all chunks."""
    for chunk in rerun_chunk.RrdReader(done.folder / REPLAY_RRD).stream():
        if chunk.entity_path != entity or chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        if column in batch.schema.names:
            times_ns = batch.column("time").cast("int64").to_pylist()
            for frame, ns, value in zip(
                batch.column("frame").to_pylist(), times_ns, batch.column(column).to_pylist(), strict=True
            ):
                if value is not None:
                    yield frame, 1e-9 * ns, value


@pytest.mark.parametrize(
    ("entity", "name"),
    [
        ("/seam/y", "seam_y_mm"),
        ("/sigma/z", "sigma_z_mm"),
        ("/offset/y", "offset_y_mm"),
        ("/arc/level", "arc_level"),
    ],
)
def test_frames_times_and_values_are_those_of_the_results(done: Replay, entity: str, name: str) -> None:
    known = [row for row in results_of(done.folder) if row[name] != ""]
    read = sorted(rows(done, entity, "Scalars:scalars"))
    assert len(read) > 5
    assert [frame for frame, _, _ in read] == [int(row["frame"]) for row in known]
    for (_, time_s, (value,)), row in zip(read, known, strict=True):
        assert time_s == pytest.approx(float(row["timestamp_s"]), abs=1e-6)
        assert_cell(value, row[name])


def test_pictures_flags_and_points(done: Replay) -> None:
    recording = done.recording
    images = {
        frame: bytes(blob[0])
        for frame, _, blob in rows(done, "/base/tool/camera/image", "EncodedImage:blob")
        if blob
    }
    readable = {row.index for row in recording.rows} - {UNREADABLE}
    assert set(images) == readable
    camera = recording.setup.camera
    for content in images.values():
        assert Image.open(io.BytesIO(content)).size == (camera.width, camera.height)
    profiles = {
        frame: np.array(points)
        for frame, _, points in rows(done, "/base/tool/profile", "Points3D:positions")
        if points
    }
    assert set(profiles) == {track.frame for track in done.tracks if track.valid}
    for track in done.tracks:
        if track.valid:
            y = profiles[track.frame][:, 1]
            assert y.min() < track.seam_tool_mm[1] < y.max()
    said = {frame: text[0] for frame, _, text in rows(done, "/flags", "TextLog:text")}
    before = None
    for row in results_of(done.folder):
        if row["flags"] != before:
            assert said[int(row["frame"])] == (row["flags"].replace("|", ", ") or "no flags")
        before = row["flags"]


def test_it_brings_its_layout(done: Replay) -> None:
    reader = rerun_chunk.RrdReader(done.folder / REPLAY_RRD)
    assert [store.application_id for store in reader.recordings()] == ["arctrack"]
    assert len(reader.blueprints()) == 1
