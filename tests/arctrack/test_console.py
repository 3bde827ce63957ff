import io
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console
from rich.progress import TextColumn
from typer.testing import CliRunner

import arctrack
from arctrack.cli import app, console
from arctrack.cli.group import paragraphs
from arctrack.cli.plan import COUNTED
from arctrack.cli.plan_text import print_plan
from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.plan.plan import PlanOptions, make_plan

ROOT = Path(arctrack.__file__).parents[1]


def paths(typer_app: typer.Typer, before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Return the words of all commands of an app and its groups."""
    found = [before]
    for command in typer_app.registered_commands:
        name = command.name or (command.callback.__name__.replace("_", "-") if command.callback else "")
        found.append((*before, name))
    for group in typer_app.registered_groups:
        if group.typer_instance is not None:
            found += paths(group.typer_instance, (*before, *str(group.typer_instance.info.name).split()))
    return found


@pytest.mark.parametrize("command", paths(app), ids=" ".join)
def test_every_help_fits_80_columns_and_has_an_example(command: tuple[str, ...]) -> None:
    runner = CliRunner(env={"COLUMNS": "80", "TERMINAL_WIDTH": "80", "TERM": "dumb", "NO_COLOR": "1"})
    result = runner.invoke(app, [*command, "--help"])
    assert result.exit_code == 0, result.output
    assert "Example: arctrack" in result.output
    assert all(len(line) <= 80 for line in result.output.splitlines())
    assert runner.invoke(app, [*command, "-h"]).output == result.output


def test_options_with_two_sides_say_what_both_do() -> None:
    pairs = 0
    for command in commands(typer.main.get_command(app)):
        for option in command.params:
            for name in option.secondary_opts:
                pairs += 1
                assert name in option.help
                assert f"{option.opts[0]} " in option.help
    assert pairs >= 3


def commands(command: Any) -> Iterator[Any]:
    """Yield a command and all below it."""
    yield command
    for each in getattr(command, "commands", {}).values():
        yield from commands(each)


def test_paragraphs_keep_apart_and_lose_their_breaks() -> None:
    assert paragraphs("One\nline.\n\nTwo\n  lines.") == "One line.\n\nTwo lines."


@pytest.mark.slow
def test_the_table_of_a_plan_fits_80_columns_whole() -> None:
    setup = balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))
    options = PlanOptions(tilt_deg=(20.0, 40.0), preview_mm=(35.0, 36.0), stand_off_mm=(140.0, 150.0))
    screen = Console(width=80, record=True, file=io.StringIO())
    print_plan(screen, make_plan(setup, options))
    table = screen.export_text().split("the paper's rules")[0]
    assert all(len(line) <= 80 for line in table.splitlines())
    assert "tilt" in table
    assert "…" not in table


def test_where_no_bar_can_be_shown_lines_say_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "SPOKEN_EVERY_S", 0.01)
    with console.SpokenProgress(TextColumn("{task.description}")) as bar:
        bar.update(bar.add_task("v: frames", total=24), completed=12)
        said = ""
        while "\n" not in said:
            said += capsys.readouterr().err
    assert re.match(r"arctrack: v: frames, 12 of 24, \d+ s\n", said)


def test_a_bar_names_what_it_counts() -> None:
    with console.progress() as bar:
        console.track(bar, "v", 24)
        bar.add_task("path", total=3, unit=COUNTED["path"])
        rate = console._Rate()
        assert [str(rate.render(task)) for task in bar.tasks[1:]] == ["– frames/s", "– stations/s"]


@pytest.mark.slow
def test_each_stage_of_a_plan_has_a_unit() -> None:
    setup = balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))
    options = PlanOptions(tilt_deg=(20.0, 40.0), preview_mm=(35.0, 36.0), stand_off_mm=(140.0, 150.0))
    told: set[str] = set()
    make_plan(setup, options, progress=lambda stage, _done, _total: told.add(stage))
    assert told <= set(COUNTED)
    assert "designs" in told


@pytest.mark.slow
def test_ctrl_c_says_what_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "long"
    # Whoever runs the tests in a shell's background has them ignore Ctrl-C, and their children too.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "from arctrack.cli import main; main()"
    options = ["--width", "160", "--height", "120", "--frames", "100000", "--fps", "1000", "--production"]
    running = subprocess.Popen(
        [sys.executable, "-c", code, "simulate", str(path), *options],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    unfinished = path.with_name("long.unfinished")
    while not (unfinished / "frames.csv").exists() and running.poll() is None:
        time.sleep(0.1)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate()
    assert running.returncode == 130, said
    assert f"long: simulation interrupted; what was written stays in {unfinished}" in said
    assert "Traceback" not in said
    assert (unfinished / "frames.csv").exists()


def test_what_gets_ready_is_shown_until_the_first_frame() -> None:
    with console.progress() as bar:
        bar.get_ready("rec")
        on_frame = console.track(bar, "rec", 3)
        assert [task.description for task in bar.tasks] == ["rec: getting ready", "rec"]
        on_frame(1)
        assert [task.description for task in bar.tasks] == ["rec"]
        bar.get_ready("next")
    assert [task.description for task in bar.tasks] == ["rec"]


def test_what_is_said_comes_through_a_pipe_at_once() -> None:
    """A process that goes on has told a reader of its output by then."""
    command = [
        sys.executable,
        "-c",
        "import sys; from arctrack.cli.console import say; say('ready'); sys.stdin.read()",
    ]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        heard, _, _ = select.select([process.stdout], [], [], 60.0)
        process.communicate()
    assert heard
