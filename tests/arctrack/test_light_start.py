"""A command that fails on its input has imported nothing of what computes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from arctrack.cli import app

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"

HEAVY = ("PIL", "aiohttp", "av", "can", "cantools", "cv2", "matplotlib", "numba", "scipy", "skimage")

RUN_EACH = f"""
import json, sys
from arctrack.cli import main
for line in sys.stdin:
    sys.argv = ["arctrack", *json.loads(line)]
    try:
        main()
    except SystemExit as end:
        print(json.dumps([end.code, [name for name in {HEAVY!r} if name in sys.modules]]))
"""

MISSING = {
    "replay": ["nowhere"],
    "check": ["nowhere"],
    "inspect": ["nowhere"],
    "explain": ["nowhere", "0"],
    "find": ["nowhere"],
    "bead": ["nowhere"],
    "shift": ["nowhere", "sound/recording.toml"],
    "new": ["taken"],
    "import": ["nowhere", "--setup", "sound", "--poses", "sound/poses.csv", "--out", "new"],
    "simulate": ["taken"],
    "plan": ["nowhere"],
    "diagnose": ["nowhere"],
    "serve": ["nowhere"],
    "doctor": ["nowhere"],
    "warm": ["nowhere"],
    "calibrate all": ["nowhere", "--setup", "sound"],
    "calibrate arc": ["nowhere"],
    "calibrate camera": ["nowhere", "--board", "chessboard:9x6:5mm"],
    "calibrate check": ["sound", "nowhere"],
    "calibrate delay": ["nowhere"],
    "calibrate export": ["nowhere", "--format", "ros", "--out", "new"],
    "calibrate filter": ["nowhere", "--setup", "sound", "--out", "new"],
    "calibrate gauge": ["nowhere", "--gauge", "step:5mm", "--setup", "sound"],
    "calibrate hand-eye": ["nowhere", "--out", "new"],
    "calibrate import": ["nowhere", "--setup", "sound"],
    "calibrate laser": ["nowhere", "--board", "chessboard:9x6:5mm", "--setup", "sound"],
    "calibrate reflectance": ["nowhere"],
    "calibrate sensor": ["nowhere"],
    "calibrate sheet": ["nowhere"],
    "cell new": ["taken"],
    "cell check": ["nowhere"],
    "cell program": ["nowhere", "--out", "places.csv"],
}
"""What each command may be given that is not there, or that is there already."""

MISSPELT = (
    ["replay", "misspelt"],
    ["replay", "--resume", "--workers", "2", "misspelt", "nowhere"],
    ["replay", "sound", "--setup", "misspelt/recording.toml"],
    ["replay", "sound", "--cell", "misspelt/cell.toml"],
    ["replay", "no_frames"],
    ["check", "misspelt"],
    ["explain", "misspelt", "0"],
    ["diagnose", "misspelt"],
    ["serve", "misspelt/cell.toml"],
    ["doctor", "misspelt/cell.toml"],
    ["warm", "misspelt", "misspelt/cell.toml"],
    ["plan", "misspelt"],
    ["simulate", "new", "--setup", "misspelt"],
    ["calibrate", "sensor", "misspelt"],
    ["calibrate", "check", "misspelt", "sound"],
)

WITHOUT_INPUT = {"cell run", "cell serve"}


def _commands(command: Any, names: str = "") -> Iterator[str]:
    inner = getattr(command, "commands", {})
    for name, each in inner.items():
        yield from _commands(each, f"{names} {name}".strip())
    if not inner:
        yield names


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """Return a folder with what the commands above name."""
    setup = (EXAMPLE / "recording.toml").read_text()
    for name, text in (
        ("sound", setup),
        ("no_frames", setup),
        ("misspelt", setup.replace("depth_mm", "dept_mm")),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "recording.toml").write_text(text)
    for table in ("frames.csv", "poses.csv"):
        (tmp_path / "sound" / table).write_text((EXAMPLE / table).read_text())
    cell = 'format = "arctrack-cell/1"\nsetup = "recording.toml"\n[camera]\nframe_rate = 25.0\n'
    (tmp_path / "misspelt" / "cell.toml").write_text(cell)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "recording.toml").write_text(setup)
    return tmp_path


def test_each_command_that_reads_is_given_something_missing() -> None:
    assert {*_commands(typer.main.get_command(app))} == {*MISSING} | WITHOUT_INPUT


@pytest.mark.slow
def test_what_fails_on_its_input_imports_nothing_that_computes(inputs: Path) -> None:
    given = [*([*command.split(), *rest] for command, rest in MISSING.items()), *MISSPELT]
    ran = subprocess.run(
        [sys.executable, "-c", RUN_EACH],
        input="".join(json.dumps(arguments) + "\n" for arguments in given),
        capture_output=True,
        text=True,
        cwd=inputs,
    )
    ends = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [(arguments, *end) for arguments, end in zip(given, ends, strict=True)] == [
        (arguments, 2, []) for arguments in given
    ]
    complaints = ran.stderr.splitlines()
    assert all(line.startswith("arctrack: error: ") for line in complaints)
    assert len(complaints) == len(given) + 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        "tracker.pipeline",
        "arctrack.control.controller",
        "arctrack.control.processor",
        "arctrack.live.serve.loop",
        "arctrack.live.black_box.recorder",
        "arctrack.live.cameras.capture.process",
    ],
)
def test_nothing_on_a_frames_way_imports_pydantic(module: str) -> None:
    """Schemas belong to files: they are read before the first frame."""
    code = f"import sys, {module}; sys.exit('pydantic' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


LATE = ("aiohttp", "scipy.signal", "scipy.stats", "skimage.measure")
"""What a page, a calibration and the weighing of mistakes take seconds and memory to load."""


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    "code",
    [
        "from arctrack.cli import main\n"
        f"sys.argv = ['arctrack', 'replay', {str(EXAMPLE)!r}, '--out', 'results']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code",
        "import arctrack.live.serve.live_run",
    ],
    ids=["replay", "serve"],
)
def test_a_sound_replay_and_a_live_loop_do_without_what_loads_slowly(code: str, tmp_path: Path) -> None:
    code = f"import sys\n{code}\nprint([name for name in {LATE!r} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, stdout=subprocess.PIPE, text=True
    )
    assert done.stdout.splitlines()[-1] == "[]"
