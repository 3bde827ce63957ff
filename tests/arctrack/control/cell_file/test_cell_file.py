"""Cell files: what they hold, what is wrong with them in one line, and how a replay goes by one."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import tomlkit
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.control.cell_file import (
    CameraChoice,
    CellFile,
    MonitorChoice,
    ProcessChoice,
    read_cell_file,
)
from arctrack.control.cell_file.new import commented_cell, write_new_cell
from arctrack.control.job import NO_JOB, Job, PartLimits
from arctrack.control.policy import ServicePolicy
from arctrack.control.recorded_job import recorded_job, with_job
from arctrack.errors import ArctrackError
from arctrack.recording import Recording, read_recording
from arctrack.replay.replay import ReplayOptions, replay_recording
from robot_io import (
    BusLogReader,
    Command,
    GateLimits,
    Received,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
)
from robot_io.poses.plausibility_limits import PlausibilityLimits

ROOT = Path(__file__).parents[4]
LAP = {
    "type": "lap",
    "thickness_mm": 2.0,
    "seam_in_base_mm": [[0.0, 0.0, 0.0], [420.0, 0.0, 0.0]],
    "surface_normal_in_base": [0.0, 0.0, 1.0],
}


@pytest.fixture(scope="module")
def new_cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, _ = write_new_cell(tmp_path_factory.mktemp("new") / "cell", "v_groove", "mild_steel")
    return path


Change = Callable[[tomlkit.TOMLDocument], object]


@pytest.fixture
def changed(new_cell: Path) -> Callable[[Change], Path]:
    def change(by: Change) -> Path:
        document = tomlkit.parse(new_cell.read_text(encoding="utf-8"))
        by(document)
        path = new_cell.parent / "changed.toml"
        path.write_text(tomlkit.dumps(document), encoding="utf-8")
        return path

    return change


def test_a_new_cell_file_says_what_is_so_unless_stated(new_cell: Path) -> None:
    cell = read_cell_file(new_cell)
    assert (str(cell.bus), cell.bus.bit_rate_bit_s) == ("virtual:arctrack", 500_000)
    assert cell.limits == GateLimits()
    assert cell.plausibility == PlausibilityLimits()
    assert cell.policy == ServicePolicy()
    assert cell.jobs[1].to_job(cell.setup.setup, cell.limits) == Job("v_groove", poses_proven=True)
    assert cell.bus_load == pytest.approx(0.1091, abs=1e-4)


def test_what_stands_behind_a_mark_in_it_can_be_taken_as_it_is(new_cell: Path) -> None:
    """Each commented key is known, has a value that it may have, and what the gate has unless stated."""
    lines = [
        line.removeprefix("# ") if re.match(r"# (\[|\w+ = )", line) else line
        for line in commented_cell().splitlines()
    ]
    path = new_cell.parent / "all.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    assert {*tomllib.loads("\n".join(lines))["gate"]} == {f.name for f in fields(GateLimits)}
    cell = read_cell_file(path)
    assert (cell.limits, cell.policy) == (GateLimits(), ServicePolicy())
    assert cell.camera == CameraChoice(25.0, "shared_memory", "cell")
    assert cell.process == ProcessChoice(50, (1,), True)
    assert cell.monitor == MonitorChoice(token="sixteen letters or more")
    job = cell.jobs[1]
    assert job.joint is not None
    assert job.joint.type == "half_v"
    assert not job.correction.z.enable
    assert job.part.gap_mm == (0.0, 1.5)


def test_the_page_shows_a_cell_file_that_can_be_read(new_cell: Path) -> None:
    page = (ROOT / "docs" / "reference" / "cell_file.md").read_text(encoding="utf-8")
    path = new_cell.parent / "page.toml"
    path.write_text(page.split("```toml\n")[1].split("```")[0], encoding="utf-8")
    cell = read_cell_file(path)
    assert cell.limits == GateLimits(range_y_mm=6.0)
    assert cell.plausibility == PlausibilityLimits(acceleration_mm_s2=3000.0)
    job = cell.jobs[12].to_job(cell.setup.setup, cell.limits)
    assert (job.joint_type, job.correction.enabled, job.correction.y.bias_mm) == ("lap", (True, False), 0.3)
    assert job.part == PartLimits(gap_mm=(0.0, 1.2), mismatch_mm=(-0.5, 0.5))
    assert job.bridging is not None
    assert job.bridging.max_mm == 8.0
    assert job.bridging.path.length_mm == 420.0
    assert job.bridging.ahead_tool_mm == pytest.approx((35.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda d: d["service"].update(round_trip_s=0.0), "[service] round_trip_s: is 0.0; it must be pos"),
        (
            lambda d: d.update(format="arctrack-cell/2"),
            "format = 'arctrack-cell/2': must be 'arctrack-cell/1'",
        ),
        (lambda d: d.update(format="joint-tracking-recording/1"), "is a setup; a cell file states format = "),
        (lambda d: d["bus"].pop("channel"), "[bus] channel: missing; state it: the channel, such as "),
        (
            lambda d: d.pop("setup"),
            "toml: setup: missing; state it: the file of the setup, from this file on",
        ),
        (lambda d: d.update(setup=3), "toml: setup = 3: input should be a valid string"),
        (lambda d: d.pop("camera"), "[camera]: missing; state it: the source of frames"),
        (lambda d: d["bus"].update(chanel=d["bus"].pop("channel")), "did you misspell it as chanel?"),
        (
            lambda d: d["bus"].update(interface="rsi", channel="here:x"),
            "[bus] channel = 'here:x': must be HOST or HOST:PORT, such as 0.0.0.0:49152",
        ),
        (
            lambda d: d["bus"].update(interface="rtde", running_word=1),
            "[bus] running_word: is of interface egm alone; leave it out",
        ),
        (
            lambda d: d["bus"].update(interface="egm", channel="0.0.0.0", running_word=0x200),
            "[bus] running_word = 512: bits 9 to 15 must be 0, bits 0 to 2 a command",
        ),
        (lambda d: d["bus"].update(bitrate=1), "[bus] bitrate: is not known; did you mean 'bit_rate_bit_s'?"),
        (lambda d: d["bus"].update(bit_rate_bit_s=20_000), "25 frames a second take 273 % of it; choose a"),
        (lambda d: d["camera"].update(frame_rate_hz=0.0), "[camera] frame_rate_hz = 0.0: input should be gr"),
        (
            lambda d: d["camera"].update(kind="shared_memory"),
            "[camera] name: missing; a camera is",
        ),
        (lambda d: d["camera"].update(name="cell"), "[camera] kind: missing; a camera is stated by kind and"),
        (lambda d: d["camera"].update(kind="v4l2", name="0"), "[camera] kind = 'v4l2': "),
        (
            lambda d: d["camera"].update(kind="gige", name="a", loop=True),
            "[camera] loop: is of kind video, folder alone; leave it out",
        ),
        (
            lambda d: d["camera"].update(kind="video", name="a", rows=[0, 9]),
            "[camera] rows: is of kind gige alone; leave it out",
        ),
        (lambda d: d["camera"].update(rows=[0, 9]), "[camera] rows: is of kind gige alone; leave it out"),
        (
            lambda d: d["camera"].update(kind="gige", name="a", rows=[3, 0]),
            "[camera] rows = [3, 0]: is the first row and how",
        ),
        (
            lambda d: d["camera"].update(kind="gige", name="a", trigger="hardware"),
            "[camera] trigger_line: goes with trigger",
        ),
        (
            lambda d: d["camera"].update(kind="gige", name="a", laser="strobe"),
            "[camera] laser: says how laser_line drives",
        ),
        (
            lambda d: d["camera"].update(kind="gige", name="a", interleave=4),
            "[camera] interleave = 4: the laser is switched",
        ),
        (
            lambda d: d["camera"].update(kind="gige", name="a", exposure="predicted"),
            "[camera] exposure_range_s",
        ),
        (
            lambda d: d["camera"].update(
                kind="gige", name="a", exposure="predicted", exposure_range_s=[0.01, 0.001]
            ),
            "[camera] exposure_range_s = [0.01, 0.001]: must rise from above 0",
        ),
        (lambda d: d["process"].update(priority=0), "[process] priority = 0: input should be greater than"),
        (lambda d: d["process"].update(cpus=[]), "[process] cpus"),
        (lambda d: d["monitor"].update(host="0.0.0.0"), "[monitor] token: missing; with host = '0.0.0.0' "),
        (lambda d: d["monitor"].update(token="short"), "[monitor] token"),
        (lambda d: d["gate"].update(jump=2.0), "[gate] jump: is not known; did you mean 'jump_mm'?"),
        (lambda d: d["gate"].update(hold_s=0.0), "[gate] hold_s: is 0.0; it must be positive and finite"),
        (lambda d: d["gate"].update(hold_s=float("nan")), "[gate] hold_s = nan: must be a finite number"),
        (
            lambda d: d["gate"].update(arc_required="no"),
            "[gate] arc_required = 'no': input should be a valid",
        ),
        (
            lambda d: d["plausibility"].update(speed_mm_s=-1.0),
            "[plausibility] speed_mm_s: is -1.0; it must be",
        ),
        (
            lambda d: d["jobs"].update({"x": d["jobs"]["1"]}),
            "[jobs.x]: a job has a whole number from 0 to 65534",
        ),
        (lambda d: d["jobs"].update({"01": d["jobs"]["1"]}), "[jobs.01]: a job has a whole number"),
        (lambda d: d["jobs"].update({"65535": d["jobs"]["1"]}), "[jobs.65535]: a job has a whole number"),
        (lambda d: d.update(jobs={}), "[jobs]: dictionary should have at least 1 item"),
        (lambda d: d["jobs"]["1"].update(bridge_mm=0.0), "[jobs.1] bridge_mm = 0.0: must be > 0"),
        (
            lambda d: d["jobs"]["1"]["part"].update(gap=[0, 1]),
            "[jobs.1.part] gap: is not known; did you mean",
        ),
        (
            lambda d: d["jobs"]["1"]["part"].update(gap_mm=[2.0, 1.0]),
            "[jobs.1.part] gap_mm = [2.0, 1.0]: must",
        ),
        (
            lambda d: d["jobs"]["1"]["part"].update(gap_mm=[2.0]),
            "[jobs.1.part] gap_mm: list should have at le",
        ),
        (
            lambda d: d["jobs"]["1"].update(joint=LAP, part={"depth_mm": [1.0, 2.0]}),
            "[jobs.1.part] depth_mm: the depth of a lap is not measured; leave it out, or choose a",
        ),
        (
            lambda d: d["jobs"]["1"]["follow"]["y"].update(gain=2.0),
            "[jobs.1.follow.y] gain = 2.0: must be > 0",
        ),
        (
            lambda d: d["jobs"]["1"].update(joint={**LAP, "type": "lop"}),
            "[jobs.1.joint] type = 'lop': there is no such joint; did you mean 'lap'?",
        ),
        (
            lambda d: d["jobs"]["1"].update(joint={**LAP, "thicknes_mm": 2.0}),
            "[jobs.1.joint] thicknes_mm: is not known; did you mean 'thickness_mm'?",
        ),
    ],
)
def test_what_is_wrong_is_one_line_with_file_key_and_cure(
    changed: Callable[[Change], Path], change: Change, complaint: str
) -> None:
    path = changed(change)
    with pytest.raises(ArctrackError) as refused:
        read_cell_file(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert complaint in str(refused.value)


def test_a_setup_that_is_not_there_is_named(changed: Callable[[Change], Path], tmp_path: Path) -> None:
    with pytest.raises(ArctrackError, match=r"nowhere\.toml: there is no such file"):
        read_cell_file(changed(lambda d: d.update(setup="nowhere.toml")))
    with pytest.raises(
        ArctrackError, match=r"cell\.toml: there is no such file; arctrack cell new writes one"
    ):
        read_cell_file(tmp_path / "cell.toml")
    with pytest.raises(ArctrackError, match=r"is a folder; give the cell\.toml in it"):
        read_cell_file(tmp_path)
    with pytest.raises(ArctrackError, match="exists already; remove it or choose another name"):
        write_new_cell(ROOT, "lap", "mild_steel")


def test_the_commands_say_what_a_cell_does(tmp_path: Path, changed: Callable[[Change], Path]) -> None:
    run = CliRunner().invoke
    done = run(app, ["cell", "new", str(tmp_path / "c"), "--joint", "lap"])
    assert done.exit_code == 0, done.output
    assert done.output.endswith(f"arctrack cell check {tmp_path / 'c' / 'cell.toml'}\n")
    done = run(app, ["cell", "check", str(tmp_path / "c" / "cell.toml")])
    assert done.exit_code == 0, done.output
    _, bus, job = done.output.splitlines()
    assert bus == (
        "bus: virtual:arctrack at 500 kbit/s; 25 frames of the camera make 404 frames on it a second, "
        "at most 11 % of its load"
    )
    assert job == "job 1: first job, a lap; y within 10 mm; z within 10 mm"

    def much(document: tomlkit.TOMLDocument) -> None:
        document["bus"]["bit_rate_bit_s"] = 125_000
        document["camera"]["frame_rate_hz"] = 120.0
        document["jobs"]["1"].update(bridge_mm=8.0, part={"gap_mm": [0.0, 1.5], "angle_deg": [55.0, 65.0]})
        document["jobs"]["1"]["follow"]["y"].update(limit_mm=3.0, bias_mm=-0.5)
        document["jobs"]["1"]["follow"]["z"].update(enable=False)

    done = run(app, ["cell", "check", str(changed(much))])
    assert done.exit_code == 1
    assert "the bus is loaded to 85 %: what is last may wait" in " ".join(done.output.split())
    assert (
        "job 1: first job, a v_groove; y within 3 mm, bias -0.5 mm; z not corrected; bridges 8 mm; "
        "gap 0 to 1.5 mm; angle 55 to 65 deg" in done.output
    )


def test_a_robots_port_is_no_bus_that_can_be_full(changed: Callable[[Change], Path]) -> None:
    def by_port(document: tomlkit.TOMLDocument) -> None:
        document["bus"].update(interface="egm", channel="0.0.0.0", bit_rate_bit_s=10_000, running_word=66_044)

    path = changed(by_port)
    done = CliRunner().invoke(app, ["cell", "check", str(path)])
    assert done.exit_code == 0, done.output
    assert "\nbus: egm:0.0.0.0, a robot's port\n" in done.output
    # A replay has no robot: it does not open the port.
    assert ReplayOptions(cell=read_cell_file(path)).chosen_bus == "virtual:arctrack"


@pytest.fixture
def two_jobs(new_cell: Path) -> CellFile:
    cell = read_cell_file(new_cell)
    only_y = replace(cell.jobs[1].correction, z=replace(cell.jobs[1].correction.z, enable=False))
    return replace(cell, jobs={1: cell.jobs[1], 12: replace(cell.jobs[1], correction=only_y)})


def test_one_of_several_jobs_must_be_named(recording: Path, two_jobs: CellFile) -> None:
    read: Recording = read_recording(recording)
    with pytest.raises(ArctrackError, match="holds the jobs 1, 12; say --job and a number"):
        with_job(read, two_jobs, None)
    with pytest.raises(ArctrackError, match=r"--job 3: .*cell\.toml holds the jobs 1, 12"):
        with_job(read, two_jobs, 3)
    with pytest.raises(ArctrackError, match="--job 3: a cell file holds the jobs; say --cell too"):
        with_job(read, None, 3)
    assert with_job(read, None, None) is read
    chosen = with_job(read, two_jobs, 12)
    assert chosen.correction.enabled == (True, False)
    assert chosen.setup is read.setup
    # A robot that names another job is refused: the tracker follows this one.
    job = recorded_job(chosen, two_jobs, 12)
    assert job.number == 12
    for number in two_jobs.jobs:
        command = TrackerCommand(Command.TRACK, True, True, 0, number, None, Switch.ON)
        job.controller.on_message(Received(0.0, command, 0), 0.0)
        assert (job.controller.job is NO_JOB) == (number != 12)


@pytest.mark.slow
def test_a_replay_goes_by_the_cell_file(simulated: Path, tmp_path: Path, two_jobs: CellFile) -> None:
    limits = replace(two_jobs.limits, range_y_mm=0.01)
    cell = replace(two_jobs, limits=limits, bus=replace(two_jobs.bus, channel="by-cell-file"))
    options = ReplayOptions(pictures=False, cell=cell, job_number=12)
    assert options.chosen_bus == "virtual:by-cell-file"
    assert replace(options, bus="virtual:other").chosen_bus == "virtual:other"
    done = replay_recording(read_recording(simulated), tmp_path, options)
    assert done.summary.refusals["out_of_range"] > 0
    assert done.recording.correction.enabled == (True, False)
    beats = [r.message for r in BusLogReader(tmp_path / "bus.blf") if isinstance(r.message, TrackerHeartbeat)]
    assert {beat.job_number for beat in beats} == {12}
    robots = replace(cell, bus=replace(cell.bus, interface="socketcan", channel="can0"))
    with pytest.raises(ArctrackError, match="--bus socketcan:can0: a replay moves what listens there"):
        replay_recording(read_recording(simulated), tmp_path, replace(options, cell=robots))
