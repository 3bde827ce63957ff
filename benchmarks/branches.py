"""Which branches of a module are taken, watched line by line.

A branch is the way from the test of an `if`, a `while` or a `for` into its body, or past it.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class Branches:
    """Watches the lines of one file.

    Parameters
    ----------
    path : str
        The file, as its code objects name it.
    source : str
        Its text.
    """

    def __init__(self, path: str, source: str) -> None:
        self._path = path
        self._steps: set[tuple[int, int]] = set()
        self._lines: set[int] = set()
        self._tree = ast.parse(source)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Watch what runs meanwhile."""
        before = sys.gettrace()
        sys.settrace(self._on_call)
        try:
            yield
        finally:
            sys.settrace(before)

    def report(self, module: str) -> Iterator[str]:
        """Yield a line for each branch that was not taken, and one for them all."""
        taken = made = 0
        for node in ast.walk(self._tree):
            if not isinstance(node, ast.If | ast.While | ast.For) or _is_for_types(node):
                continue
            tested = node.iter if isinstance(node, ast.For) else node.test
            test = range(node.lineno, (tested.end_lineno or node.lineno) + 1)
            body = range(node.body[0].lineno, (node.body[-1].end_lineno or 0) + 1)
            leaves = {to for start, to in self._steps if start in test and to not in test}
            for name, is_taken in (
                ("into its body", any(to in body for to in leaves)),
                ("past it", any(to not in body for to in leaves)),
            ):
                made += 1
                taken += is_taken
                if not is_taken:
                    yield f"  {module}:{node.lineno}: not {name}"
        yield f"{module}: {taken} of {made} branches taken"

    def _on_call(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        if frame.f_code.co_filename != self._path:
            return None
        last = [0]

        def on_line(frame: FrameType, event: str, _argument: Any) -> Any:
            if event == "line":
                self._steps.add((last[0], frame.f_lineno))
                last[0] = frame.f_lineno
            elif event == "return":
                self._steps.add((last[0], -1))
            elif event == "exception":
                # Who leaves by an exception has taken no branch.
                last[0] = 0
            return on_line

        return on_line


def _is_for_types(node: ast.If | ast.While | ast.For) -> bool:
    """Say whether a branch is for type checkers alone."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
