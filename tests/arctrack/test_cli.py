import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import pytest
from made import without_progress
from typer.testing import CliRunner

import arctrack
from arctrack import __version__
from arctrack.cli import app
from arctrack.cli.crash import crash
from arctrack.cli.exit_codes import CRASHED, INTERRUPTED, READER_GONE
from arctrack.errors import ArctrackError
from arctrack.recording import read_recording

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
ROOT = Path(arctrack.__file__).parents[1]
COMMAND = [sys.executable, "-c", "from arctrack.cli import main; main()"]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, env=environment, check=False
    )


def test_help_has_an_example_and_loads_nothing_heavy() -> None:
    for command in ([], ["replay"], ["inspect"], ["explain"], ["import"], ["simulate"]):
        result = RUNNER.invoke(app, [*command, "--help"])
        assert result.exit_code == 0
        assert "Example: arctrack" in result.output
    code = (
        "import sys; import arctrack.cli; "
        "print([m for m in ('numba', 'matplotlib', 'numpy', 'cv2', 'can', 'av') if m in sys.modules])"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert loaded.stdout.strip() == "[]"


LOST_INTERRUPT = """
import ctypes
from arctrack.cli import app, run_app

def interrupt():
    raise KeyboardInterrupt

@app.command()
def compile():
    ctypes.CFUNCTYPE(None)(interrupt)()
    raise RuntimeError("no compiled object yet")

run_app(app, "arctrack")
"""


def test_an_interrupt_in_a_callback_of_the_compiler_is_no_fault_of_arctrack() -> None:
    """Python drops what is raised there, and numba misses what was to be compiled."""
    command = [sys.executable, "-c", LOST_INTERRUPT, "compile"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    finished = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert finished.returncode == INTERRUPTED, finished.stderr
    assert finished.stderr == "arctrack: arctrack compile interrupted; what it had finished stays\n"


def test_version() -> None:
    result = RUNNER.invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.output.strip() == f"arctrack {__version__}"


@pytest.mark.slow
def test_simulate_replay_inspect_in_a_row(tmp_path: Path) -> None:
    path = tmp_path / "lap"
    options = ["--joint", "lap", "--material", "zn_coated", "--width", "160", "--height", "120"]
    made = RUNNER.invoke(app, ["simulate", str(path), *options, "--frames", "13", "--seed", "3", "--video"])
    assert made.exit_code == 0, made.output
    assert (path / "frames.mkv").exists()
    again = RUNNER.invoke(app, ["simulate", str(tmp_path / "again"), "--setup", str(path), "--frames", "12"])
    assert again.exit_code == 0, again.output
    assert read_recording(tmp_path / "again").setup.joint == read_recording(path).setup.joint

    replayed = RUNNER.invoke(
        app, ["replay", str(path), str(tmp_path / "again"), "--out", str(tmp_path / "out"), "--no-pictures"]
    )
    assert replayed.exit_code == 0, replayed.output
    for name in ("lap", "again"):
        assert (tmp_path / "out" / name / "results.csv").exists()
        assert name in replayed.output
    assert "RMS" in replayed.output

    seen = RUNNER.invoke(app, ["inspect", str(path), "--out", str(tmp_path / "lap.png")])
    assert seen.exit_code == 0, seen.output
    for text in ("160 x 120 px", "lap: thickness_mm 2", "zn_coated", " Hz from -0.4", "at 8.00 mm/s", "140"):
        assert text in seen.output
    assert cv2.imread(str(tmp_path / "lap.png")).shape[1] > 1000


@pytest.mark.slow
def test_without_the_arc_map_both_are_shown_side_by_side(simulated: Path, tmp_path: Path) -> None:
    result = RUNNER.invoke(
        app, ["replay", str(simulated), "--no-arc-map", "--no-pictures", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.output.splitlines()]
    assert [line[0] for line in lines if line[1:2] == ["lateral"]] == ["no", "yes"]
    assert json.loads((tmp_path / "summary.json").read_text())["arc_map"] is False


@pytest.mark.slow
def test_a_recording_without_truth_has_no_error_table(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    (path / "truth.csv").unlink()
    result = RUNNER.invoke(app, ["replay", str(path), "--no-pictures"])
    assert result.exit_code == 0, result.output
    assert "nothing to score" in result.output
    assert (path / "results" / "results.csv").exists()


@pytest.mark.slow
def test_warnings_are_one_line_each(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    with (path / "recording.toml").open("a") as file:
        file.write("\n[effects.gamma]\ngamma = 0.7\n[extra]\nkey = 1\n")
    result = RUNNER.invoke(app, ["inspect", str(path)])
    assert result.exit_code == 0, result.output
    warnings = without_progress(result.stderr)
    assert len(warnings) == 1
    assert all(line.startswith("arctrack: warning: ") for line in warnings)
    assert "[extra] is not known" in warnings[0]
    assert "known beforehand: gamma" in result.stdout


@pytest.mark.slow
def test_a_picture_has_the_name_that_is_said(simulated: Path, tmp_path: Path) -> None:
    for name in ("seen", "seen.png", "seen.pdf"):
        result = RUNNER.invoke(app, ["inspect", str(simulated), "--out", str(tmp_path / name)])
        assert result.exit_code == 0, result.output
        assert f"picture  {tmp_path / name}" in result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seen", "seen.pdf", "seen.png"]


@pytest.mark.slow
def test_a_recording_that_fails_does_not_stop_the_others(simulated: Path, tmp_path: Path) -> None:
    bad = Path(shutil.copytree(simulated, tmp_path / "bad"))
    (bad / "truth.csv").write_text("frame,seam_x_mm,seam_y_mm,seam_z_mm\n0,1,2\n")
    good = Path(shutil.copytree(simulated, tmp_path / "good"))
    out = tmp_path / "out"
    result = RUNNER.invoke(
        app, ["replay", str(tmp_path / "gone"), str(bad), str(good), "--no-pictures", "--out", str(out)]
    )
    assert result.exit_code == 2
    # A machine that has to compile says so too.
    assert [line for line in result.stderr.splitlines() if "error" in line] == [
        f"arctrack: error: {tmp_path / 'gone'}: there is no such folder",
        f"arctrack: error: {bad / 'truth.csv'}, line 2: has 3 values where the header names 4",
    ]
    assert [path.name for path in out.iterdir()] == ["good"]
    assert (out / "good" / "summary.json").exists()
    assert f"good: results in {out / 'good'}" in result.stdout


@pytest.mark.slow
def test_a_recordings_setup_is_not_written_over(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "r"))
    own = path / "recording.toml"
    before = own.read_text()
    result = RUNNER.invoke(app, ["calibrate", "hand-eye", str(path), "--out", str(own)])
    assert isinstance(result.exception, ArctrackError)
    assert "give --out another file" in str(result.exception)
    assert own.read_text() == before


@pytest.mark.slow
def test_the_installed_way(simulated: Path, tmp_path: Path) -> None:
    done = run("replay", str(simulated), "--out", str(tmp_path), "--no-pictures")
    assert done.returncode == 0, done.stderr
    assert without_progress(done.stderr) == []
    assert "lateral" in done.stdout
    bad = run("replay", str(tmp_path / "nowhere"))
    assert bad.returncode == 2
    assert bad.stderr == f"arctrack: error: {tmp_path / 'nowhere'}: there is no such folder\n"
    assert bad.stdout == ""


@pytest.mark.slow
@pytest.mark.parametrize("error", ["ZeroDivisionError", "EOFError", "BrokenPipeError", "SyntaxError"])
def test_a_fault_of_arctrack_has_a_code_of_its_own(error: str, tmp_path: Path) -> None:
    code = (
        "import arctrack.live.doctor.examine as run; from arctrack.cli import main\n"
        f"def fail(folder): raise {error}('two\\nlines')\n"
        "run.examine_machine = fail; main()"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", code, "doctor"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == CRASHED
    (kept,) = tmp_path.iterdir()
    assert done.stderr == (
        f"arctrack: error: arctrack itself failed, {error}: two lines; "
        f"the traceback is in {kept}, to report it with\n"
    )
    assert "Traceback" in kept.read_text()
    assert "in fail" in kept.read_text()
    assert kept.stat().st_mode & 0o077 == 0


def test_a_fault_whose_file_cannot_be_written_is_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(SystemExit) as ended:
        crash(ValueError("why"))
    assert ended.value.code == CRASHED
    said = capsys.readouterr().err
    assert "ValueError: why\n" in said
    assert said.endswith(
        "arctrack: error: arctrack itself failed, ValueError: why; the traceback stands above\n"
    )


@pytest.mark.slow
def test_results_that_nobody_reads_are_no_crash(simulated: Path, tmp_path: Path) -> None:
    command = [*COMMAND, "inspect", str(simulated), "--out", str(tmp_path / "seen.png")]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        said = running.stderr.read().decode()
    assert running.returncode == READER_GONE
    assert "error" not in said
    assert [path for path in tmp_path.iterdir() if path.name.startswith("arctrack-")] == []


def test_a_shell_completes_commands() -> None:
    asked = {"_ARCTRACK_COMPLETE": "complete_bash", "COMP_WORDS": "arctrack cal", "COMP_CWORD": "1"}
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | asked
    done = subprocess.run(COMMAND, capture_output=True, text=True, env=environment, check=False)
    assert done.stdout.split() == ["calibrate"]
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["replya"], "'replay'"),
        (["calibrate", "camra"], "'camera'"),
    ],
)
def test_a_command_that_is_not_there_is_guessed(words: list[str], meant: str) -> None:
    result = RUNNER.invoke(app, words)
    assert result.exit_code == 2
    assert f"Did you mean {meant}" in result.output


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["figures", "paper", "--out", "figures"], "validation.figures"),
        (["diagnose", "check", "make"], "validation.blind_check"),
        (["cell", "schedules", "--help"], "validation.fault_schedules"),
    ],
)
def test_a_moved_command_answers_with_the_new_one(words: list[str], command: str) -> None:
    done = subprocess.run([*COMMAND, *words], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2
    moved = " ".join(words[: 1 if words[0] == "figures" else 2])
    assert (
        done.stderr
        == f"arctrack: error: arctrack {moved} is now python -m {command}, in a clone of arctrack\n"
    )
    help_ = subprocess.run(
        [sys.executable, "-m", command, "--help"], capture_output=True, text=True, cwd=ROOT
    )
    assert help_.returncode == 0
    assert f"python -m {command}" in help_.stdout


def test_a_path_that_is_not_there_is_guessed(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(recording, Path("lines") / "v_groove")
    Path("lines/v_grooves.zip").touch()
    for words, problem in (
        (["replay", "lines/v_grove"], "lines/v_grove: there is no such folder; did you mean lines/v_groove?"),
        (
            ["check", "linse/v_groove"],
            "linse/v_groove: there is no such folder; did you mean lines/v_groove?",
        ),
        (["replay", "lines/monday"], "lines/monday: there is no such folder"),
        (
            ["plan", "lines/v_groove/recordings.toml"],
            "lines/v_groove/recordings.toml: there is no such file; a recording needs one; "
            "did you mean lines/v_groove/recording.toml?",
        ),
        (
            ["doctor", "lines/cell.toml"],
            "lines/cell.toml: there is no such file; arctrack cell new writes one",
        ),
    ):
        result = RUNNER.invoke(app, words)
        said = result.stderr.removeprefix("arctrack: error: ").strip() or str(result.exception)
        assert said == problem
    (Path("lines/v_groove") / "poses.csv").unlink()
    result = RUNNER.invoke(app, ["replay", "lines/v_groove"])
    assert "did you mean" not in result.output


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_killed_replay_leaves_its_rows(simulated: Path, tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    # It stops after the fifth frame, so that the kill strikes in the middle.
    code = (
        "import sys; from pathlib import Path; from arctrack.recording import read_recording; "
        "from arctrack.replay.replay import replay_recording; "
        "replay_recording(read_recording(sys.argv[1]), Path(sys.argv[2]), "
        "on_frame=lambda n: n < 5 or (print(n, flush=True), sys.stdin.read()))"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, str(simulated), str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"5\n"
        process.kill()
    rows = results.read_bytes()
    assert rows.endswith(b"\n")
    assert 4 <= rows.count(b"\n") < 15
