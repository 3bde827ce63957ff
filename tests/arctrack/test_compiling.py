"""Two processes compile for a third: real ones, that do it, die, hang, and outlive nobody."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_child_process import children, is_there, wait_until
from test_getting_ready import KERNELS

pytestmark = pytest.mark.slow

needs_proc = pytest.mark.skipif(sys.platform != "linux", reason="asks Linux which processes there are")

ROOT = Path(__file__).parents[2]

PARTS = f"""{KERNELS}
import os, signal, time
def double() -> None:
    doubled(3.0)
def square() -> None:
    squared(3.0)
def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)
def fail() -> None:
    raise ValueError("not here")
def hang() -> None:
    time.sleep(3600)
"""

WORK = """
import os, sys
os.sched_getaffinity = lambda _: set(range(2))
import parts
from arctrack import compiling
from noise_model.compiled.forecast import Forecast
from tracker.warm_up import compilations_reported
forecast, chosen = Forecast("three kernels"), [getattr(parts, name) for name in sys.argv[2:]]
exec(sys.argv[1])
with compiling.compiled_by(chosen), forecast.running(), compilations_reported(None, forecast) as compiled:
    results = [kernel(3.0) for kernel in (parts.halved, parts.doubled, parts.squared)]
assert results == [1.5, 6.0, 9.0]
forecast.keep()
here = [k.__name__ for k in (parts.halved, parts.doubled, parts.squared) if k.stats.cache_misses]
print("here:", *here)
print("heard:", *sorted({name.removeprefix("parts.") for name in compiled}))
"""

NONE_STARTS = "compiling.ChildProcess = None; "


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return that of a process with three kernels, none of them compiled."""
    (tmp_path / "parts.py").write_text(PARTS)
    path, kept = os.pathsep.join((str(ROOT), str(tmp_path))), str(tmp_path / "kept")
    packs = str(tmp_path / "no packs")
    return {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": kept, "ARCTRACK_PACKS": packs}


def said(environment: dict[str, str], *parts: str, first: str = "") -> list[str]:
    """Return what a process prints that needs three kernels and gives the parts away, after it ran code."""
    command = [sys.executable, "-c", WORK, first, *parts]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == "", "what others say would break a bar"
    return done.stdout.splitlines()


ALL_HEARD = "heard: doubled halved squared"


def test_two_compile_all_but_what_began_and_are_heard(environment: dict[str, str]) -> None:
    assert said(environment, "double", "square") == ["here: halved", ALL_HEARD]
    assert said(environment, "double", "square") == ["here:", "heard:"]


@pytest.mark.parametrize(
    ("part", "first"),
    [
        ("die", ""),
        ("fail", ""),
        ("hang", "compiling.STALLED_S = 5.0"),
        ("double", "sys.executable = '/nowhere/python'"),
        ("double", "import arctrack.child_process as child; child.CODE = 'raise SystemExit(1)'"),
    ],
)
def test_what_they_do_not_compile_is_compiled_here(
    environment: dict[str, str], part: str, first: str
) -> None:
    here, heard = said(environment, part, "square", first=first)
    assert here.startswith("here: halved doubled")
    assert heard == ALL_HEARD


@pytest.mark.parametrize(
    "first",
    [
        "os.sched_getaffinity = lambda _: {0}",
        "import arctrack.compiling as c; c.kernels_are_stored = lambda: False",
        "c = compiling.multiprocessing; c.parent_process = c.current_process",
    ],
)
def test_none_starts_where_it_would_not_help(environment: dict[str, str], first: str) -> None:
    alone = said(environment, "double", "square", first=NONE_STARTS + first)
    assert alone == ["here: halved doubled squared", ALL_HEARD]


def test_none_starts_for_little(environment: dict[str, str], tmp_path: Path) -> None:
    said(environment, "double", "square")
    for kept in tmp_path.glob("kept/arctrack/kernels/parts.squared/*"):
        kept.unlink()
    again = said(environment, "double", "square", first=NONE_STARTS)
    assert again == ["here: squared", "heard: squared"]


@pytest.fixture
def warming(environment: dict[str, str]) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Return a first `arctrack warm`, and the two processes that have begun to compile for it."""
    code = (
        "import os, signal\n"
        # What a shell starts in the background ignores SIGINT.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "os.sched_getaffinity = lambda _: {0, 1}\n"
        "from arctrack.cli import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", code, "warm", str(ROOT / "examples" / "v_groove")]
    kept = Path(environment["NUMBA_CACHE_DIR"])
    with subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            wait_until(lambda: len(children(process.pid)) == 2 and any(kept.glob("*/*/*/*")))
            yield process, children(process.pid)
        finally:
            process.kill()


@needs_proc
def test_ctrl_c_ends_all_three_in_one_line(warming: tuple[subprocess.Popen[str], list[int]]) -> None:
    process, compilers = warming
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate()
    assert process.returncode == 130
    told = [line for line in stderr.splitlines() if not re.search("getting ready|compiling, ", line)]
    assert len(told) == 1, told
    assert not any(map(is_there, compilers))


@needs_proc
def test_they_end_with_the_command(warming: tuple[subprocess.Popen[str], list[int]]) -> None:
    process, compilers = warming
    process.kill()
    wait_until(lambda: not any(map(is_there, compilers)))
