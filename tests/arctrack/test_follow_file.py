"""[follow] of recording.toml: read, checked, and honoured by what a replay sends."""

from __future__ import annotations

import csv
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from made import replace_in, small_setup

from arctrack.cli.inspect_text import correction_words
from arctrack.errors import ArctrackError
from arctrack.recording import format_setup, read_recording
from arctrack.recording.setup_file import SetupFile, parse_setup
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.simulation.simulate import SimulationPlan, simulate_recording
from noise_model.setup import Setup
from robot_io import BusLogReader, SeamOffset, TrackerState, TrackerStatus, Validity
from tracker.seam.correction import AxisCorrection, Correction

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "follow.md"
QUICK = ReplayOptions(pictures=False)


def stated(follow: str, tmp_path: Path) -> SetupFile:
    return parse_setup(format_setup(small_setup()) + follow, tmp_path / "recording.toml")


def test_every_key_is_read(tmp_path: Path) -> None:
    follow = """
[follow]
when_lost = "hold"
extrapolate_mm = 6
extrapolate_sigma_mm = 0.3
ends_mm = 15.0
corrugation = "followed"
[follow.y]
gain = 0.9
bias_mm = 0.5
limit_mm = 3.0
at_limit = "stop"
[follow.z]
enable = false
"""
    found = stated(follow, tmp_path)
    assert found.correction == Correction(
        y=AxisCorrection(gain=0.9, bias_mm=0.5, limit_mm=3.0, at_limit="stop"),
        z=AxisCorrection(enable=False),
        when_lost="hold",
        extrapolate_mm=6.0,
        extrapolate_sigma_mm=0.3,
        ends_mm=15.0,
        corrugation="followed",
    )
    assert found.unknown_keys == ()
    assert correction_words(found.correction) == (
        "when_lost hold, extrapolate_mm 6.0, extrapolate_sigma_mm 0.3, ends_mm 15.0, corrugation followed, "
        "y.gain 0.9, y.bias_mm 0.5, y.limit_mm 3.0, y.at_limit stop, z.enable false"
    )


def test_a_file_that_says_nothing_of_it(tmp_path: Path) -> None:
    assert stated("", tmp_path).correction == Correction()
    assert stated("\n[follow.z]\n", tmp_path).correction == Correction()


def test_the_pages_example_is_read(tmp_path: Path) -> None:
    example = PAGE.read_text().split("```toml\n", 1)[1].split("```", 1)[0]
    found = stated("\n" + example, tmp_path)
    assert found.unknown_keys == ()
    assert found.correction != Correction()


def test_unknown_keys_are_reported(tmp_path: Path) -> None:
    found = stated("\n[follow]\nspeed = 1\n[follow.y]\ngian = 1.0\n", tmp_path)
    assert found.unknown_keys == ("[follow] speed", "[follow.y] gian")


@pytest.mark.parametrize(
    ("follow", "complaint"),
    [
        (
            "[follow]\nwhen_lost = 'wait'",
            "[follow] when_lost = 'wait': must be 'hold', 'extrapolate' or 'stop'",
        ),
        ("[follow]\nextrapolate_mm = -1", "[follow] extrapolate_mm = -1.0: must be >= 0"),
        ("[follow]\nextrapolate_sigma_mm = nan", "[follow] extrapolate_sigma_mm = nan: must be a finite"),
        ("[follow.y]\ngain = 2", "[follow.y] gain = 2.0: must be > 0 and at most 1"),
        ("[follow.z]\nlimit_mm = 0", "[follow.z] limit_mm = 0.0: must be > 0"),
        ("[follow.z]\nat_limit = 'cut'", "[follow.z] at_limit = 'cut': must be 'saturate' or 'stop'"),
        ("[follow.y]\nenable = 1", "[follow.y] enable = 1: "),
        ("[follow.y]\nbias_mm = 3\nlimit_mm = 1", "[follow.y] bias_mm = 3.0: is beyond limit_mm = 1.0"),
    ],
)
def test_what_cannot_be_is_refused(follow: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ArctrackError) as error:
        stated(f"\n{follow}\n", tmp_path)
    assert f"recording.toml: {complaint}" in str(error.value)


# Replays.


def replayed(source: Path, folder: Path, follow: str) -> tuple[list[dict[str, str]], list[object]]:
    """Replay a recording with other tables at the end of its setup; return its rows and its messages."""
    path = Path(shutil.copytree(source, folder / "copy"))
    with (path / "recording.toml").open("a") as file:
        file.write(follow)
    replay_recording(read_recording(path), folder / "out", QUICK)
    with (folder / "out" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    return rows, [received.message for received in BusLogReader(folder / "out" / "bus.blf")]


@pytest.fixture(scope="module")
def plain(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    return replayed(simulated, tmp_path_factory.mktemp("plain"), "")[0]


@pytest.mark.slow
def test_the_bus_hears_the_corrected_offset(
    simulated: Path, plain: list[dict[str, str]], tmp_path: Path
) -> None:
    wanted_mm = [0.5 * float(row["offset_y_mm"] or "nan") + 0.1 for row in plain]
    limit_mm = round(float(np.nanmedian(np.abs(wanted_mm))), 3)
    follow = f"\n[follow.y]\ngain = 0.5\nbias_mm = 0.1\nlimit_mm = {limit_mm}\n[follow.z]\nenable = false\n"
    rows, messages = replayed(simulated, tmp_path, follow)
    sent = [message for message in messages if isinstance(message, SeamOffset)]
    cut = 0
    assert sent.pop().validity is Validity.REFUSED
    for row, before, wanted, message in zip(rows, plain, wanted_mm, sent, strict=True):
        assert row["offset_z_mm"] == ""
        assert math.isnan(message.offset_z_mm)
        assert (row["offset_y_mm"] == "") == (before["offset_y_mm"] == "")
        # The first one is that of the soft start.
        if message.validity is not Validity.VALID or message.confidence == 0.0:
            continue
        assert float(row["offset_y_mm"]) == pytest.approx(np.clip(wanted, -limit_mm, limit_mm), abs=2e-5)
        assert message.offset_y_mm == pytest.approx(float(row["offset_y_mm"]), abs=1e-3)
        assert ("offset_limited" in row["flags"]) == (abs(wanted) > limit_mm)
        cut += "offset_limited" in row["flags"]
    assert 0 < cut < sum(message.validity is Validity.VALID for message in sent)


def test_without_an_axis_nothing_is_corrected(simulated: Path, tmp_path: Path) -> None:
    rows, _ = replayed(simulated, tmp_path, "\n[follow.y]\nenable = false\n[follow.z]\nenable = false\n")
    assert all(row["offset_y_mm"] == row["offset_z_mm"] == "" for row in rows)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert "no_axis_enabled" in summary["offsets"]["reasons"]


@pytest.mark.slow
def test_following_that_has_stopped_is_refused_at_once_and_disarms(
    simulated: Path, plain: list[dict[str, str]], tmp_path: Path
) -> None:
    offsets = [abs(float(row["offset_y_mm"])) for row in plain if row["offset_y_mm"]]
    limit_mm = 0.5 * (min(offsets) + max(offsets))
    rows, messages = replayed(
        simulated, tmp_path, f"\n[follow.y]\nlimit_mm = {limit_mm}\nat_limit = 'stop'\n"
    )
    stopped = ["follow_stopped" in row["flags"] for row in rows]
    first = stopped.index(True)
    assert all(
        stop or not row["flags"] for stop, row in zip(stopped, rows, strict=True) if row["flags"] == ""
    )
    assert all(row["offset_y_mm"] == row["offset_z_mm"] == "" for row in rows[first:])
    states = [message.state for message in messages if isinstance(message, TrackerStatus)]
    assert states.pop() is TrackerState.DISARMED
    assert [state is TrackerState.DISARMED for state in states] == stopped


def test_a_setup_of_another_file_brings_its_own(simulated: Path, tmp_path: Path) -> None:
    text = (simulated / "recording.toml").read_text() + "\n[follow]\nwhen_lost = 'stop'\n"
    (tmp_path / "other.toml").write_text(text)
    assert read_recording(simulated).correction == Correction()
    assert read_recording(simulated, tmp_path / "other.toml").correction.when_lost == "stop"


def blacken(path: Path, frames: range) -> None:
    for n in frames:
        picture = path / "frames" / f"{n:06d}.png"
        cv2.imwrite(str(picture), np.full_like(cv2.imread(str(picture), cv2.IMREAD_UNCHANGED), 4))


@pytest.mark.slow
def test_a_held_seam_is_sent_and_the_tracker_says_that_it_holds(seen_setup: Setup, tmp_path: Path) -> None:
    """Seen from 35 to 39 mm, then never again: the torch gets there in frame 18 and passes it in frame 20."""
    plan = SimulationPlan(frames=23, travel_speed_mm_s=20.0, production=True, weave_mm=0.0, tilt_deg=0.0)
    path = simulate_recording(tmp_path / "r", seen_setup, plan)
    blacken(path, range(3, 23))
    rows, messages = replayed(path, tmp_path, '\n[follow]\nwhen_lost = "hold"\nextrapolate_mm = 3.5\n')
    held = [20, 21]
    assert [n for n, row in enumerate(rows) if "offset_held" in row["flags"]] == [*held, 22]
    offsets = [message for message in messages if isinstance(message, SeamOffset)]
    assert [offsets[n].validity for n in (18, *held, 22)] == [Validity.VALID] * 3 + [Validity.HELD]
    assert rows[20]["offset_y_mm"] == rows[21]["offset_y_mm"] == rows[22]["offset_y_mm"] != ""
    states = [message.state for message in messages if isinstance(message, TrackerStatus)]
    assert [n for n, state in enumerate(states) if state is TrackerState.HOLDING] == [*held, 22]


@pytest.mark.slow
def test_a_start_that_was_found_is_in_the_summary(seen_setup: Setup, tmp_path: Path) -> None:
    """The first frames are black, as before a plate: the joint starts where the laser meets one."""
    setup = replace(
        seen_setup, joint=replace(seen_setup.joint, seam_in_base_mm=((40.0, 0.0, 0.0), (900.0, 0.0, 0.0)))
    )
    plan = SimulationPlan(frames=20, travel_speed_mm_s=20.0, production=True, weave_mm=0.0, tilt_deg=0.0)
    path = simulate_recording(tmp_path / "r", setup, plan)
    blacken(path, range(7))
    start_mm = 40.0 + 35.0 + 2.0 * 6.5
    replace_in(path / "recording.toml", "[[40.0, 0.0, 0.0]", f"[[{start_mm - 6.0}, 0.0, 0.0]")
    with (path / "recording.toml").open("a") as file:
        file.write("\n[follow]\nends_mm = 15.0\n")
    summary = replay_recording(read_recording(path), tmp_path / "out", QUICK).summary
    written = json.loads((tmp_path / "out" / "summary.json").read_text())["joint_ends"]
    assert list(written) == list(summary.joint_ends_mm) == ["start"]
    assert written["start"]["station_mm"] == pytest.approx(start_mm, abs=1.5)
    assert 0.3 < written["start"]["sigma_mm"] < 1.5
    assert summary.flags["before_joint"] == summary.frames
