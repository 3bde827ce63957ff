"""Every command of the documentation is run or, where that cannot be, parsed by what it names."""

from __future__ import annotations

import argparse
import importlib
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import cv2
import pytest
import typer
from documented import run, run_once, run_shown
from pages import EVERY_PAGE, ROOT, Command, Script, links, name, quoted_commands, steps

from arctrack.cli import app

pytestmark = pytest.mark.slow

PARSED_ONLY = {
    r"python3 -m venv ": "the README's two set up an environment; CI runs the second, which runs this test",
    r"pip install ": "needs a package index",
    r"pytest ": "is run as a test of its own",
    r"python benchmarks/": "takes minutes to hours",
    r"python -m validation.blind_check ": "takes hours, and needs Mitsuba",
    r"python -m validation.bench ": "takes minutes to hours; tests/validation/test_bench.py runs it",
    r"python -m validation.fault_schedules --count \d{3,} ": "takes minutes; tests/validation runs each",
    r".*\b(monday|tuesday)\b": "names the reader's own recordings",
    r".*\bsocketcan:": "needs CAN hardware",
    r"arctrack cell serve ": "needs a bus that processes share; simulation/cell/test_live.py runs one",
    r"(\.venv/bin/)?arctrack serve ": "runs until it is ended; tests of live/serve run it beside a cell",
    r"python -m validation.figures effects ": "takes a minute; test_effects_page.py draws each",
}
"""Commands that are parsed and not run, as regular expressions, and why."""

SHELL = ("cp", "sed")
"""Programs that a page's reader has."""

SETUP = re.compile(r"python3 -m venv .venv && (.venv/bin/pip install [^&]* && )+")
"""What the README's commands begin with: it sets up the environment that the tests are in."""


def is_run(command: str) -> bool:
    return not any(re.match(pattern, command) for pattern in PARSED_ONLY)


class _ParsedError(Exception):
    """A script has read its command line."""


def parse_typer(commands: typer.Typer, words: list[str]) -> None:
    """Read a command line as these commands do, and do nothing."""
    command = typer.main.get_command(commands)
    _do_nothing(command)
    with pytest.raises(SystemExit) as ended:
        command(args=words, prog_name="arctrack")
    assert not ended.value.code, f"exit code {ended.value.code}"


def _do_nothing(command: Any) -> None:
    """Take what a command does from it and from those below it; what reads its options stays."""
    if not hasattr(command, "commands"):
        command.callback = None
    for below in getattr(command, "commands", {}).values():
        _do_nothing(below)


def _has_options(path: Path) -> bool:
    """Whether a script, or a module beside it that it imports, reads a command line."""
    text = path.read_text(encoding="utf-8")
    beside = (path.parent / f"{name}.py" for name in re.findall(r"^(?:from|import) (\w+)", text, re.M))
    return "parse_args" in text or any(_has_options(module) for module in beside if module.exists())


def parse_script(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Read a command line as a script does that has one."""
    path = ROOT / words[0]
    if not _has_options(path):
        assert not [word for word in words[1:] if word.startswith("-")]
        return
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(parser: argparse.ArgumentParser) -> None:
        parse(parser)
        raise _ParsedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.syspath_prepend(path.parent)
    with pytest.raises(_ParsedError):
        runpy.run_path(str(path), run_name="__main__")


def parse_module(name: str, *words: str) -> None:
    """Read a command line as a module does that has commands; without words it is there."""
    module = ROOT.joinpath(*name.split("."))
    assert module.with_suffix(".py").exists() or (module / "__main__.py").exists()
    if words and module.is_dir():
        main = vars(importlib.import_module(f"{name}.__main__"))
        parse_typer(next(each for each in main.values() if isinstance(each, typer.Typer)), list(words))


def check_pytest(words: list[str]) -> None:
    for word in words:
        if not word.startswith("-"):
            path, _, test = word.partition("::")
            assert f"def {test}" in (ROOT / path).read_text(encoding="utf-8")


def check_install(words: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra in re.findall(r"\[(\w+)\]", " ".join(words)):
        assert extra in extras


def parse(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold a command against the program that it names."""
    command = SETUP.sub("", command).removeprefix("taskset -c 0 ").removesuffix(' || echo "exit code $?"')
    program, *words = shlex.split(command)
    program = Path(program).name
    if program == "arctrack":
        parse_typer(app, words)
    elif program == "pytest":
        check_pytest([word for word in words if word.startswith("tests/")])
    elif program == "pip":
        check_install(words)
    elif program == "python" and words[0] == "-m":
        parse_module(*words[1:])
    elif program == "python":
        parse_script(words, monkeypatch)
    elif program in SHELL:
        assert shutil.which(program)
    else:
        raise AssertionError(f"no test knows {program}")


ALL = sorted(
    {(name(page), step.text) for page in EVERY_PAGE for step in steps(page) if isinstance(step, Command)}
)
QUOTED = sorted({(name(page), command) for page in EVERY_PAGE for command in quoted_commands(page)})


@pytest.mark.parametrize(("page", "command"), ALL + QUOTED)
def test_every_command_is_one(page: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parse(command, monkeypatch)


def examples(command: Any) -> list[str]:
    """Return the examples that the help of a command, and of those below it, ends with."""
    found = re.findall(r"Example: (arctrack .+)", command.epilog or "")
    return found + [line for below in getattr(command, "commands", {}).values() for line in examples(below)]


@pytest.mark.parametrize("command", sorted({*examples(typer.main.get_command(app))}))
def test_every_example_of_the_help_is_one(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parse(command, monkeypatch)


@pytest.mark.parametrize(
    "command",
    [
        "arctrack replay examples/v_groove --no-map",
        "arctrack simulat /tmp/lap",
        "arctrack explain examples/v_groove twelve",
        "python benchmarks/seam_error.py --simulated 3",
        "python benchmarks/arc_image.py --all",
        "python -m validation.fault_schedules --simulated 3",
        "pytest tests/test_house.py::test_of_nothing",
        "pip install 'arctrack[everything]'",
        "sudo reboot",
    ],
)
def test_a_command_that_is_none_is_seen(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises((SystemExit, AssertionError, FileNotFoundError)):
        parse(command, monkeypatch)


def to_run(page: Path) -> list[Command | Script]:
    return [step for step in steps(page) if isinstance(step, Script) or is_run(step.text)]


NUMBER = re.compile(r"\d+(?:\.(\d+))?")


def is_as_shown(line: str, shown: str) -> bool:
    """Return whether a line reads as a page shows it, but for one unit of a number's last digit."""
    if NUMBER.split(line)[::2] != NUMBER.split(shown)[::2]:
        return False
    pairs = zip(NUMBER.finditer(line), NUMBER.finditer(shown), strict=True)
    return all(abs(float(a[0]) - float(b[0])) < 1.5 * 10.0 ** -len(b[1] or "") for a, b in pairs)


def missing(output: str, shown: tuple[str, ...]) -> list[str]:
    """Return the lines that a page shows and that an output does not have, in the order of either."""
    lines = iter([" ".join(line.split()) for line in output.splitlines()])
    wanted = [line for line in shown if line != "…"]
    return [line for line in wanted if not any(is_as_shown(given, line) for given in lines)]


def test_an_output_that_is_not_as_shown_is_seen() -> None:
    output = "RMS   0.041\n\nvalid 17 of 24"
    assert missing(output, ("RMS 0.042", "…", "valid 17 of 24")) == []
    assert missing(output, ("RMS 0.051",)) == ["RMS 0.051"]
    assert missing(output, ("valid 17 of 24", "RMS 0.041")) == ["RMS 0.041"]
    assert missing(output, ("valid 17 of all",)) == ["valid 17 of all"]


@pytest.mark.parametrize("page", list(filter(to_run, EVERY_PAGE)), ids=name)
def test_a_page_does_what_it_shows(page: Path, scratch: Path, shared: Path) -> None:
    """Run a page from top to bottom: a step may use what one before it has written.

    A picture of the page that a step writes is the page's, within a grey level.
    """
    for step in to_run(page):
        if isinstance(step, Script):
            text = step.text.replace("/tmp/", f"{scratch / 'tmp'}/")
            output = run([sys.executable, "-W", "error", "-c", text], scratch)
            assert missing(output, step.shown) == [], output
        else:
            # What edits files in place is cheap, and is run on each page.
            is_pure = step.text.startswith(("arctrack ", "python examples/make_", "python -m validation."))
            output = run_once(step.text, scratch, shared) if is_pure else run_shown(step.text, scratch)
            assert missing(output, step.shown) == [], output
    for link in links(page):
        made = scratch / "tmp" / Path(link).name
        if link.endswith(".png") and made.exists():
            pictures = [cv2.imread(str(path)).astype(int) for path in (made, page.parent / link)]
            assert abs(pictures[0] - pictures[1]).max() <= 1, link
