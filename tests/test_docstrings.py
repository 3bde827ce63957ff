"""Docstrings: numpydoc's sections are for what the reference prints; a few lines say the rest."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.house

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("arctrack", "calibration", "noise_model", "robot_io", "sim_to_real", "tracker")
SECTION = re.compile(r"^-{4,}$", re.MULTILINE)


def printed_by_the_reference() -> set[str]:
    """Return the names that autodoc prints; one that ends in a dot stands for all members of a class."""
    names: set[str] = set()
    module = name = ""
    for page in sorted((ROOT / "docs" / "reference").glob("api*.md")):
        for line in page.read_text().splitlines():
            if found := re.match(r"\.\. currentmodule:: (\S+)", line):
                module = found[1]
            elif found := re.match(r"\.\. auto\w+:: (\w+)", line):
                documented = getattr(importlib.import_module(module), found[1])
                name = f"{documented.__module__}.{documented.__qualname__}"
                names.add(name)
            elif found := re.match(r"\s+:members:(.*)", line):
                names |= {f"{name}.{member.strip()}" for member in found[1].split(",")}
    return names


def names_with_sections(tree: ast.AST, place: str) -> Iterator[str]:
    for node in ast.iter_child_nodes(tree):
        inner = place
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            inner = f"{place}.{node.name}"
            if SECTION.search(ast.get_docstring(node) or ""):
                yield inner
        yield from names_with_sections(node, inner)


def test_only_what_the_reference_prints_has_numpydoc_sections() -> None:
    printed = printed_by_the_reference()
    wrong = []
    for package in PRODUCT:
        for path in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            named = names_with_sections(ast.parse(path.read_text()), module)
            wrong += [name for name in named if not {name, name.rpartition(".")[0] + "."} & printed]
    assert wrong == []


def test_a_section_is_seen_in_a_method() -> None:
    source = 'class A:\n    def b(self):\n        """Do.\n\n        Raises\n        ------\n        """'
    assert list(names_with_sections(ast.parse(source), "m")) == ["m.A.b"]


NO_NOUN = re.compile(r"^(?:What|By how much|How|Say|So (?:many|much|far|often)|Whether|Where)\b")
"""How a docstring begins that does not say what a thing is or returns."""


def first_lines(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            text = getattr(getattr(statement, "value", None), "value", None)
            if isinstance(statement, ast.Expr) and isinstance(text, str):
                yield text.strip().partition("\n")[0]


@pytest.mark.parametrize("room", PRODUCT)
def test_first_lines_say_what_a_thing_is_or_returns(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    lines = [(file.name, line) for file in files for line in first_lines(file.read_text())]
    assert len(lines) > 200
    assert [line for line in lines if NO_NOUN.match(line[1])] == []


PRIVATE_WORDS = re.compile(r"(?:^|_)(?:alike|askew|beside|dear|heard|nought|told)(?:_|$)", re.IGNORECASE)


FOLDERS = ("recording", "control", "simulation", "diagnose", "plan", "report", "calibrate")
PUBLIC = {"beside_px", "BESIDE_PX", "command_heard", "heard_robot_status"}
"""A column of the stripe that `import arctrack` gives, a signal of the bus, a key of summary.json."""


@pytest.mark.parametrize(
    "room", [*(room for room in PRODUCT if room != "arctrack"), *(f"arctrack/{name}" for name in FOLDERS)]
)
def test_names_are_words_of_the_field(room: str) -> None:
    nodes = [node for file in (ROOT / room).rglob("*.py") for node in ast.walk(ast.parse(file.read_text()))]
    names = {
        name
        for node in nodes
        for name in (getattr(node, "id", None), getattr(node, "arg", None), getattr(node, "name", None))
        if isinstance(name, str) and PRIVATE_WORDS.search(name)
    }
    assert names <= PUBLIC
