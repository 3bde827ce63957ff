"""While kernels are compiled, a bar or lines say how many, of how many, and how long it takes."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

KERNELS = """
from noise_model.compiled.kernel import kernel
@kernel
def halved(x: float) -> float:
    return 0.5 * x
@kernel
def doubled(x: float) -> float:
    return 2.0 * x
@kernel
def squared(x: float) -> float:
    return x * x
"""

WORK = """
from arctrack.cli import console
console.SPOKEN_EVERY_S = 0.01
with console.progress() as bar:
    bar.get_ready("three")
    import three_kernels
    from noise_model.compiled.forecast import Forecast
    from tracker.warm_up import compilations_reported
    forecast = Forecast("three kernels")
    with forecast.running(), compilations_reported(None, forecast):
        for kernel in (three_kernels.halved, three_kernels.doubled, three_kernels.squared):
            kernel(3.0)
    forecast.keep()
console.say("ready")
"""

LINE = r"arctrack: (three: )?(getting ready|compiling(, (\d of 3|\d) functions)?), \d+ s(, about \d+ s left)?"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return that of a process with three kernels, none of them compiled."""
    (tmp_path / "three_kernels.py").write_text(KERNELS)
    path = os.pathsep.join((str(ROOT), str(tmp_path)))
    return {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), "TERM": "xterm"}


def _forget_kernels(folder: Path) -> None:
    for kept in folder.glob("kept/arctrack/kernels/three_kernels.*/*"):
        kept.unlink()


@pytest.mark.slow
def test_a_pipe_gets_lines_and_none_after_it_is_ready(tmp_path: Path, environment: dict[str, str]) -> None:
    def said() -> list[str]:
        command = [sys.executable, "-c", WORK]
        ran = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        return ran.stdout.splitlines()

    *first, last = said()
    assert last == "ready"
    assert all(re.fullmatch(LINE, line) for line in first)
    assert any("compiling, 2 functions" in line for line in first)
    _forget_kernels(tmp_path)
    *again, last = said()
    assert last == "ready"
    assert all(re.fullmatch(LINE, line) for line in again)
    assert any("compiling, 2 of 3 functions" in line and "left" in line for line in again)


@pytest.mark.slow
def test_a_terminal_gets_a_bar_that_is_gone_once_it_is_ready(environment: dict[str, str]) -> None:
    screen, terminal = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", WORK], env=environment, stdout=terminal, stderr=terminal):
        os.close(terminal)
        shown = b""
        try:
            while piece := os.read(screen, 65536):
                shown += piece
        except OSError:
            os.close(screen)
    text = shown.decode()
    assert "three: getting ready" in text
    assert re.search(r"three: compiling .*[123]/\?", text)
    assert re.split(r"\r|\n|\x1b\[[0-9;?]*[A-Za-z]", text.rstrip())[-1] == "ready"
