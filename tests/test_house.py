"""The rooms and what each may import; lint, format and types; the README's two commands."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

MAY_IMPORT = {
    "noise_model": set(),
    "tracker": {"noise_model"},
    "robot_io": set(),
    "calibration": {"noise_model", "tracker"},
    "sim_to_real": {"noise_model", "tracker"},
    "arctrack": {"noise_model", "tracker", "robot_io", "calibration", "sim_to_real"},
}
MAX_FUNCTION_LINES = 100
ONLY_IN_ARCTRACK = {"matplotlib", "jinja2", "rich", "typer", "pydantic", "av", "aiohttp"}


def imported(source: str, path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and top-level package of every import, relative and late ones included."""
    room = path.relative_to(ROOT).parts[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name.split(".")[0]
        elif isinstance(node, ast.ImportFrom):
            depth = len(path.relative_to(ROOT).parts) - 1
            above_room = node.level > depth
            yield (
                node.lineno,
                "beyond" if above_room else room if node.level else (node.module or "").split(".")[0],
            )
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module" and node.args:
            name = node.args[0]
            if isinstance(name, ast.Constant) and isinstance(name.value, str):
                yield node.lineno, name.value.split(".")[0]


def wrong_imports(path: Path) -> list[str]:
    """Return what a file imports against the table."""
    room = path.relative_to(ROOT).parts[0]
    forbidden = (set(MAY_IMPORT) - MAY_IMPORT[room] - {room}) | {"beyond"}
    if room != "arctrack":
        forbidden |= ONLY_IN_ARCTRACK
    return [
        f"{path.relative_to(ROOT)}:{line} imports {package}"
        for line, package in imported(path.read_text(), path)
        if package in forbidden
    ]


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_import_only_what_the_table_allows(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    assert [wrong for file in files for wrong in wrong_imports(file)] == []


@pytest.mark.parametrize(
    "source",
    [
        "import tracker.step",
        "def f():\n    from arctrack import replay",
        "from ..tracker import step",
        "import importlib\nimportlib.import_module('robot_io.codec')",
        "import matplotlib.pyplot as plt",
    ],
)
def test_the_table_is_enforced(source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "noise_model").mkdir()
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    file = tmp_path / "noise_model" / "bad.py"
    file.write_text(source)
    assert len(wrong_imports(file)) == 1


def test_no_function_is_longer_than_a_hundred_lines() -> None:
    long = [
        f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"
        for folder in (*MAY_IMPORT, "benchmarks", "examples", "tests")
        for file in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or node.lineno) - node.lineno + 1 > MAX_FUNCTION_LINES
    ]
    assert long == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"], ["vulture"]],
    ids=["lint", "format", "types", "dead code"],
)
def test_code_is_clean(command: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_hooks_are_well_formed() -> None:
    command = [sys.executable, "-m", "pre_commit", "validate-config", ROOT / ".pre-commit-config.yaml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_readme_opens_with_two_commands() -> None:
    text = (ROOT / "README.md").read_text()
    block = text.split("```sh\n", 1)[1].split("```", 1)[0].strip().splitlines()
    assert len(block) == 2
    assert "arctrack replay examples/" in block[0]
    assert "pytest" in block[1]
    assert all(line.startswith("python3 -m venv ") for line in block)


def test_changelog_opens_with_the_version_that_is_built() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    released = re.findall(r"^## \[(\d[^\]]*)\] - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert released[0] == project["version"]
