"""The measure of the tests: mutants of a source, and branches that nobody takes."""

from __future__ import annotations

import ast
import textwrap
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"

SOURCE = textwrap.dedent(
    '''
    """A docstring, 1."""
    from typing import TypeVar
    M = TypeVar("M")
    LIMIT: float = 2.5

    def clipped(x: int, sign: bool = True) -> int:
        """Another, with 3."""
        if not sign and x <= 7:
            raise ValueError(f"{x + 1} is too small")
        y = -x * LIMIT
        return y if sign else 0
    '''
)


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return __import__("mutants"), __import__("branches")


def test_each_operator_constant_result_and_statement_is_changed_once(tools: tuple[Any, Any]) -> None:
    made = [(mutant.line, mutant.change) for mutant in tools[0].mutants(SOURCE)]
    assert sorted(made) == [
        (5, "2.5 to 1.5"),
        (5, "2.5 to 3.5"),
        (7, "True to False"),
        (9, "7 to 6"),
        (9, "7 to 8"),
        (9, "LtE to Gt"),
        (9, "LtE to Lt"),
        (9, "and to or"),
        (9, "not left out"),
        (10, "Raise left out"),
        (11, "Assign left out"),
        (11, "Mult to Div"),
        (11, "minus left out"),
        (12, "0 to -1"),
        (12, "0 to 1"),
        (12, "None returned"),
        (12, "branches exchanged"),
    ]


def test_a_mutant_differs_in_that_one_place_and_runs(tools: tuple[Any, Any]) -> None:
    whole = ast.unparse(ast.parse(SOURCE)).splitlines()
    for mutant in tools[0].mutants(SOURCE):
        changed = ast.unparse(mutant.tree).splitlines()
        compile(mutant.tree, "mutant", "exec")
        assert len(changed) == len(whole)
        assert sum(a != b for a, b in zip(changed, whole, strict=True)) == 1


def test_a_branch_that_nobody_takes_is_named(tools: tuple[Any, Any], tmp_path: Path) -> None:
    source = textwrap.dedent(
        """
        def count(values, least=0):
            n = 0
            for value in values:
                if (
                    value > least
                ):
                    n += 1
            while n > 99:
                n -= 1
            if n:
                return n
        """
    )
    path = str(tmp_path / "watched.py")
    names: dict[str, Any] = {}
    exec(compile(source, path, "exec"), names)
    branches = tools[1].Branches(path, source)
    with branches.watched():
        names["count"]([1, 2])
    assert list(branches.report("watched.py")) == [
        "  watched.py:9: not into its body",
        "  watched.py:11: not past it",
        "  watched.py:5: not past it",
        "watched.py: 5 of 8 branches taken",
    ]
    with branches.watched():
        names["count"]([0])
        names["count"]([1] * 101)
    assert list(branches.report("watched.py")) == ["watched.py: 8 of 8 branches taken"]
