"""`arctrack diagnose`: what it writes, prints, applies and refuses; recordings in turn and at once."""

import json
import pickle
import shutil
import sys
import types
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from diagnosis_examples import GAMMA, GLARE, Effects, example
from made import replace_in, without_progress
from typer.testing import CliRunner, Result

from arctrack import cli
from arctrack.diagnose.diagnose import DiagnosisJob, DiagnosisResult, at_once, jobs_for, without_images
from arctrack.diagnose.diagnosis_files import FILES
from arctrack.diagnose.pages import words
from arctrack.errors import ArctrackError
from arctrack.recording import read_recording
from arctrack.workers import FailedJob, cluster, processes
from noise_model.setup import Setup
from sim_to_real.diagnosis import Diagnosis, DiagnosisVerdict
from tracker.state import Frame

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})

Found = Callable[[DiagnosisVerdict, Effects], None]

NO_LASER = "[laser]: missing; did you misspell it as loser?"


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> Found:
    """Let every diagnosis find what it is told to."""
    stub = types.ModuleType("sim_to_real.diagnose")
    monkeypatch.setitem(sys.modules, "sim_to_real.diagnose", stub)

    def find(verdict: DiagnosisVerdict, effects: Effects = GAMMA) -> None:
        def diagnose(
            setup: Setup,
            frames: Sequence[Frame],
            pose_at: object,
            *,
            without: Sequence[str],
            on_stage: object,
            threads: int,
        ) -> Diagnosis:
            if len(frames) < 14:
                raise ValueError("two frames of each kind are the least")
            if "spatter" in without:
                raise TypeError("a fault")
            if callable(on_stage):
                on_stage("fits effects", 0.5)
            return example(verdict, setup, effects)

        stub.diagnose = diagnose

    find(DiagnosisVerdict.EFFECTS)
    return find


@pytest.fixture
def recording(simulated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(simulated, tmp_path / "v"))


def run(*arguments: object) -> Result:
    return RUNNER.invoke(cli.app, ["diagnose", *map(str, arguments)])


def refused(*arguments: object) -> str:
    with pytest.raises(ArctrackError) as raised:
        RUNNER.invoke(cli.app, ["diagnose", *map(str, arguments)], catch_exceptions=False)
    return str(raised.value)


def test_one_recording_on_one_screen(found: Found, recording: Path) -> None:
    found(DiagnosisVerdict.EFFECTS, GAMMA | GLARE)
    result = run(recording)
    assert result.exit_code == 0, result.output
    assert {path.name for path in (recording / "diagnosis").iterdir()} == set(FILES)
    lines = result.stdout.splitlines()
    assert len(lines) < 30
    assert lines[0].startswith("The model does not hold: p < 0.0001")
    assert lines[1].startswith("2 effects explain the gap together: gamma (the response")
    assert "the gap in the images shrinks from" in lines[2]
    assert "0.25 mm that the weld can bear" in lines[3]
    text = " ".join(result.stdout.split())
    for part in (
        "gamma gamma = 0.7400 ± 0.0074",
        "gamma moves the seam 0.001 mm (0.001 to 0.001) to the side and 0.212 mm (0.200 to 0.221) in height",
        "grey level (81 %)",
        "wrong_material | fume",
        "two exposures",
    ):
        assert part in text
    # The best five of eight, named by what they are.
    assert "thermal emission" in text
    assert "more fall-off" not in text
    assert lines[-1] == f"report in {recording / 'diagnosis' / 'report.html'}"
    assert json.loads((recording / "diagnosis" / "report.json").read_text())["verdict"] == "effects"


def test_help_shows_an_example() -> None:
    result = run("--help")
    assert result.exit_code == 0
    assert "Example: arctrack diagnose" in result.output


def test_an_effect_that_does_not_exist(found: Found, recording: Path) -> None:
    assert refused(recording, "--without", "gama") == (
        "--without gama: there is no such effect; did you mean 'gamma'?"
    )
    assert "there are arc_length, arc_deflection" in refused(recording, "--without", "xyz")
    assert not (recording / "diagnosis").exists()


def test_what_is_left_out_reaches_the_diagnosis_and_the_page(found: Found, recording: Path) -> None:
    result = run(recording, "--without", "gamma", "--without", "fume")
    assert result.exit_code == 0, result.output
    folder = recording / "diagnosis"
    page = (folder / "report.html").read_text()
    assert "catalogue: gamma and fume" in page
    line = "You left gamma and fume out: the answer is among the effects that were allowed;"
    assert line in page
    assert line in result.stdout
    assert json.loads((folder / "report.json").read_text())["withheld"] == ["gamma", "fume"]
    assert "You left" not in run(recording).stdout
    other = shutil.copytree(recording, recording.with_name("other"))
    both = run(recording, other, "--without", "gamma", "--without", "fume").stdout
    assert [f"{name}: {line[:-1]}" in both for name in (recording.name, "other")] == [True, True]


def test_what_stays_of_the_gap_is_told_where_effects_are_left_out(
    found: Found, recording: Path, seen_setup: Setup
) -> None:
    """The named effect alone closes 71 % in bins, though all of it in single pixels."""
    diagnosis = example(DiagnosisVerdict.EFFECTS, seen_setup)
    ranking = tuple(replace(c, gap_closed=0.71) if c.id == "gamma" else c for c in diagnosis.ranking)
    line = words.withheld(replace(diagnosis, ranking=ranking), ["defocus"])
    assert line == (
        "You left defocus out: the answer is among the effects that were allowed; "
        "29 % of the gap stays in bins with gamma."
    )
    several = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA | GLARE)
    several = replace(several, gap=replace(several.gap, closed=0.9))
    line = words.withheld(several, ["defocus"])
    assert line.endswith("10 % of the gap stays in single pixels with gamma and veiling_glare.")
    assert "stays" not in words.withheld(example(DiagnosisVerdict.UNKNOWN, seen_setup), ["defocus"])


def test_effects_are_written_into_the_setup(found: Found, recording: Path) -> None:
    file = recording / "recording.toml"
    old = "# the sensor of cell 4\n" + file.read_text()
    old += "\n[effects.veiling_glare] # smeared\nspread = 1.0 # a guess\nhue = 3\n"
    file.write_text(old)
    file.chmod(0o640)
    found(DiagnosisVerdict.EFFECTS, GAMMA | GLARE)
    result = run(recording, "--apply")
    assert result.exit_code == 0, result.output
    assert (
        f"{file}: wrote [effects.gamma] gamma = 0.74, bend = 0, [effects.veiling_glare] share = 0.15"
        in result.stdout
    )
    setup = read_recording(recording).setup
    assert setup.effects == {
        "gamma": {"gamma": 0.74, "bend": 0.0},
        "veiling_glare": {"share": 0.15, "spread": 0.6},
    }
    new = file.read_text()
    assert "gamma = 0.74 # ± 0.0074, found by arctrack diagnose" in new
    kept = [line for line in old.splitlines() if line and not line.startswith("spread")]
    assert [line for line in new.splitlines() if line in kept] == kept
    assert file.stat().st_mode & 0o777 == 0o640
    assert [path.name for path in recording.iterdir() if "recording.toml" in path.name] == ["recording.toml"]


@pytest.mark.parametrize("verdict", [DiagnosisVerdict.AMBIGUOUS, DiagnosisVerdict.UNKNOWN])
def test_what_is_open_is_not_written(verdict: DiagnosisVerdict, found: Found, recording: Path) -> None:
    found(verdict)
    before = (recording / "recording.toml").read_bytes()
    result = run(recording, "--apply")
    assert result.exit_code == 2
    (error,) = without_progress(result.stderr)
    assert error.startswith(f"arctrack: error: {recording / 'recording.toml'}: nothing was written")
    assert f"'{verdict.value}'" in error
    assert (recording / "recording.toml").read_bytes() == before
    assert (recording / "diagnosis" / "report.html").exists()


def test_without_a_gap_there_is_nothing_to_write(found: Found, recording: Path) -> None:
    found(DiagnosisVerdict.NO_GAP)
    result = run(recording, "--apply")
    assert result.exit_code == 0, result.output
    assert "no gap, so there is nothing to write" in result.stdout


def test_options_that_do_not_go_together(found: Found, recording: Path) -> None:
    assert "leave --setup out" in refused(recording, "--apply", "--setup", recording / "recording.toml")
    assert "take one" in refused(recording, "--workers", "2", "--scheduler", "tcp://127.0.0.1:1")
    assert "would replace another" in refused(recording, recording)
    assert jobs_for([recording], Path("out"))[0].folder == Path("out").absolute()


def test_one_that_fails_does_not_stop_the_others(found: Found, simulated: Path, tmp_path: Path) -> None:
    paths = [Path(shutil.copytree(simulated, tmp_path / name)) for name in ("a", "b", "c")]
    replace_in(paths[0] / "recording.toml", "[laser]", "[loser]")
    (paths[2] / "frames" / "000002.png").unlink()
    result = run(*paths, "--out", tmp_path / "out")
    assert result.exit_code == 2
    first, second = without_progress(result.stderr)[-2:]
    assert first == f"arctrack: error: {paths[0]}/recording.toml: {NO_LASER}"
    assert second == f"arctrack: error: {paths[2]}: two frames of each kind are the least"
    assert {path.name for path in (tmp_path / "out" / "b").iterdir()} == set(FILES)
    assert f"b: report in {tmp_path}/out/b/report.html" in result.stdout


@pytest.mark.slow
def test_frames_that_cannot_be_read_are_left_out(found: Found, recording: Path) -> None:
    with (recording / "frames.csv").open("a") as file:
        file.write("14,1.4,1,1,100,0.005\n")
    result = run(recording)
    assert result.exit_code == 2
    (error,) = without_progress(result.stderr)
    assert "000014.png: there is no such file" in error
    assert "1 of 15 frames could not be used, the diagnosis is that of the others" in error
    assert (recording / "diagnosis" / "report.json").exists()
    shutil.rmtree(recording / "frames")
    (recording / "frames").mkdir()
    (recording / "frames" / "000000.png").write_bytes(b"")
    assert "no frame of" in run(recording).stderr


def test_a_fault_is_not_hidden(found: Found, recording: Path, simulated: Path, tmp_path: Path) -> None:
    other = shutil.copytree(simulated, tmp_path / "w")
    result = run(recording, other, "--without", "spatter")
    assert isinstance(result.exception, TypeError)
    assert result.stderr.count("TypeError: a fault") == 2


def test_recordings_at_once_come_as_they_are_done(found: Found, simulated: Path, tmp_path: Path) -> None:
    paths = [Path(shutil.copytree(simulated, tmp_path / name)) for name in ("a", "b")]
    (paths[0] / "poses.csv").unlink()
    with ThreadPoolExecutor(2) as executor:
        outcomes = {outcome.job.name: outcome for outcome in at_once(jobs_for(paths), executor)}
    assert isinstance(outcomes["a"], FailedJob)
    assert "poses" in outcomes["a"].problem
    assert isinstance(outcomes["b"], DiagnosisResult)
    assert len(pickle.dumps(outcomes["b"])) < 100_000
    assert (paths[1] / "diagnosis" / "report.json").exists()


@pytest.mark.slow
def test_two_processes(simulated: Path, tmp_path: Path) -> None:
    paths = [Path(shutil.copytree(simulated, tmp_path / name)) for name in ("a", "b")]
    for path in paths:
        replace_in(path / "recording.toml", "[laser]", "[loser]")
    result = run(*paths, "--workers", "2")
    assert result.exit_code == 2
    # A slow machine is told how far it is.
    assert sorted(line for line in result.stderr.splitlines() if "error" in line) == [
        f"arctrack: error: {path}/recording.toml: {NO_LASER}" for path in paths
    ]


@pytest.mark.slow
def test_a_process_that_ends_is_one_line(tmp_path: Path) -> None:
    with processes(1) as executor:
        (outcome,) = at_once([EndsIt(tmp_path / "r", tmp_path / "d")], executor)
    assert isinstance(outcome, FailedJob)
    assert outcome.foreseen
    assert outcome.problem == (
        f"{tmp_path}/r: its process ended, for want of memory perhaps; try fewer --workers"
    )


class EndsIt(DiagnosisJob):
    """A job that ends the process which unpacks it."""

    def __reduce__(self) -> tuple[object, ...]:
        return sys.exit, (3,)


def test_a_diagnosis_travels_without_its_images(seen_setup: Setup) -> None:
    diagnosis = example(DiagnosisVerdict.EFFECTS, seen_setup)
    small = without_images(diagnosis)
    assert small.gap == diagnosis.gap
    assert small.predicted.frames.tolist() == [3, 7, 11, 15]
    assert small.predicted.before.size == small.where.z.size == 0


def test_without_dask_the_cure_is_named(
    found: Found, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert refused(recording, "--scheduler", "tcp://127.0.0.1:1") == (
        "--scheduler needs Dask: pip install 'arctrack[cluster]'"
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_dask_cluster(found: Found, recording: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    with distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=None) as here:
        result = run(recording, "--scheduler", here.scheduler_address)
    assert result.exit_code == 0, result.output
    assert (recording / "diagnosis" / "report.json").exists()


@pytest.mark.filterwarnings("default")
def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    monkeypatch.setattr("arctrack.workers.CONNECT_S", 0.3)
    with pytest.raises(ArctrackError, match="no scheduler answers"), cluster("tcp://127.0.0.1:9"):
        pass
