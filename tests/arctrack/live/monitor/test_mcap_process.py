"""A live run's MCAP file, written by a process of its own and read back by MCAP's own reader."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from made import playing_cell
from PIL import Image
from shown_run import ShownRun, example, tracked
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.errors import ArctrackError
from arctrack.live.black_box.recorder import END, JobSetup
from arctrack.live.monitor.mcap_process import run_mcap
from arctrack.live.monitor.options import McapOptions
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor

mcap_reader = pytest.importorskip("mcap.reader")

TOML = "format = 'a setup'\n"


@contextmanager
def written_run(folder: Path) -> Iterator[ShownRun]:
    """Yield a run while another process writes its MCAP file."""
    name = f"mcap-{folder.name}-{os.getpid()}"
    run = ShownRun(name)
    try:
        options = McapOptions(name, folder, {7: JobSetup(example().setup, TOML)})
        process = SupervisedProcess("mcap", run_mcap, (options,), ends_s=30.0)
        with Supervisor(print).running(process, END):
            process.wait_ready()
            yield run
    finally:
        run.close()


def messages_of(path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Return times, ns, and messages by topic, in order."""
    by_topic = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in mcap_reader.make_reader(file, validate_crcs=True).iter_messages():
            by_topic[channel.topic].append((message.log_time, json.loads(message.data)))
    return by_topic


def test_a_run_is_written_as_it_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    began_s = time.time()
    with written_run(folder) as run:
        enough = run.count + 60
        while run.count < enough:
            time.sleep(0.1)
    (path,) = folder.iterdir()
    by_topic = messages_of(path)
    assert set(by_topic) == {
        "/camera/annotations", "/camera/calibration", "/camera/image", "/profile", "/state", "/tf", "/track",
    }  # fmt: skip
    # The images are the run's frames, each at its time of day.
    pictures = by_topic["/camera/image"]
    assert len(pictures) > 5
    times_ns = [ns for ns, _ in by_topic["/track"]]
    assert times_ns == sorted(set(times_ns))
    assert all(began_s - 1.0 < 1e-9 * ns < time.time() for ns in times_ns)
    jpeg = base64.b64decode(pictures[0][1]["data"])
    height, width = tracked()[0][0].frame.image_dn.shape
    assert Image.open(io.BytesIO(jpeg)).size == (width, height)
    # Seam and offset are what the tracker found and the loop sent.
    seams = {round(view.track.seam_tool_mm[1], 6) for _, view in tracked() if view.track.valid}
    shown = {round(track["seam_y_mm"], 6) for _, track in by_topic["/track"] if track["valid"]}
    assert shown
    assert shown <= seams
    states = [state for _, state in by_topic["/state"]]
    assert {state["state"] for state in states} == {"TRACKING"}
    assert [state["frames"] for state in states] == sorted(state["frames"] for state in states)
    with path.open("rb") as file:
        (attachment,) = mcap_reader.make_reader(file).iter_attachments()
    assert (attachment.name, attachment.data.decode()) == ("job_7.toml", TOML)


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_cell_that_states_a_folder_is_served_into_it(simulated: Path, tmp_path: Path) -> None:
    cell = playing_cell(tmp_path / "cell", simulated)
    document = tomlkit.parse(cell.read_text())
    document["mcap"]["folder"] = "runs"
    cell.write_text(tomlkit.dumps(document))
    done = CliRunner().invoke(app, ["serve", str(cell)])
    assert done.exit_code == 0, done.output
    (path,) = (cell.parent / "runs").iterdir()
    by_topic = messages_of(path)
    tracked_frames = int(re.search(r"frames: (\d+), dropped", done.stdout)[1])
    # The last state is from before the run's end.
    assert 0 < by_topic["/state"][-1][1]["frames"] <= tracked_frames
    frames = [track["frame"] for _, track in by_topic["/track"]]
    assert frames
    assert frames == sorted(set(frames))


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("")
    told = r"runs: cannot be written: .*; state another \[mcap\] folder"
    with pytest.raises(ArctrackError, match=told), written_run(tmp_path / "runs"):
        pass
