"""Whether the tests of a module see when it is wrong: mutants killed, and branches taken.

    python benchmarks/mutation.py [MODULE...] [--most N] [--seed N] [--seconds N] [--branches]

A module's own tests run on each mutant (`benchmarks/mutants.py`), in a process of its own that shares what
was loaded before. A mutant is killed if a test fails, or none of them ends in time. Where a module has more
mutants than `--most`, so many are drawn by `--seed`. Each survivor is printed with its line.
`--branches` runs the tests once on the module as it is, and prints each branch that none of them takes.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.abc
import importlib.machinery
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import CodeType, ModuleType

import pytest
from branches import Branches
from mutants import Mutant, mutants

ROOT = Path(__file__).resolve().parents[1]
TESTS = {
    "robot_io/protocol/codec.py": ("tests/robot_io/test_codec.py",),
    "robot_io/protocol/protect.py": ("tests/robot_io/test_protect.py",),
    "robot_io/gate.py": ("tests/robot_io/test_gate.py",),
    "robot_io/poses/pose_buffer.py": ("tests/robot_io/test_pose_buffer.py",),
    **dict.fromkeys(
        ("robot_io/poses/plausibility.py", "robot_io/poses/pose_questions.py"),
        ("tests/robot_io/test_plausibility.py", "tests/robot_io/test_plausibility_bounds.py"),
    ),
}
"""The modules whose tests must see what is wrong, and these tests."""

LOADED_BEFORE = (
    "can",
    "cantools",
    "e2e.p11",
    "hypothesis.extra.numpy",
    "scipy.spatial.transform",
    "tracker.tracker",
)
"""What tests need that takes long to load, and that no mutant is in."""

NO_TESTS = 5
"""pytest's exit code where there was nothing to run."""

KILLED, SURVIVED, TIMED_OUT = "killed", "survived", "killed by time"


class _Loader(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from code of its own."""

    def __init__(self, name: str, path: Path, code: CodeType) -> None:
        self._name, self._path, self._code = name, path, code

    def find_spec(self, name: str, *_: object) -> importlib.machinery.ModuleSpec | None:
        """Return where the module comes from, None for all others."""
        if name != self._name:
            return None
        return importlib.machinery.ModuleSpec(name, self, origin=str(self._path))

    def exec_module(self, module: ModuleType) -> None:
        """Run the module's code."""
        module.__file__ = str(self._path)
        exec(self._code, vars(module))


def in_a_fork(run: Callable[[], int], seconds: float) -> int | None:
    """Return the exit code of what runs in a process like this one; None if it was stopped by time."""
    child = os.fork()
    if child == 0:
        signal.alarm(0)
        try:
            code = run()
        except BaseException:
            code = 1
        os._exit(min(code, 255))
    ends_s = time.monotonic() + seconds
    while time.monotonic() < ends_s:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def run_tests(module: str, tree: ast.Module, quiet: bool = True) -> int:
    """Run a module's tests with its code taken from a tree; return pytest's exit code."""
    path = ROOT / module
    name = module.removesuffix(".py").replace("/", ".")
    sys.meta_path.insert(0, _Loader(name, path, compile(tree, str(path), "exec")))
    if quiet:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
    options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "--no-header", "--tb=no"]
    # What is loaded before is not loaded by pytest's own hook.
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    # The quick ones first: most mutants need no others.
    for chosen in ("not slow", "slow"):
        code = int(pytest.main([*options, "-m", chosen, *(str(ROOT / file) for file in TESTS[module])]))
        if code not in (0, NO_TESTS):
            return code
    return 0


def fate(module: str, mutant: Mutant, seconds: float) -> str:
    """Return what became of a mutant."""
    code = in_a_fork(lambda: run_tests(module, mutant.tree), seconds)
    if code is None:
        return TIMED_OUT
    return SURVIVED if code == 0 else KILLED


def score(module: str, most: int, seed: int, seconds: float) -> None:
    """Print what became of a module's mutants."""
    source = (ROOT / module).read_text(encoding="utf-8")
    drawn = list(mutants(source))
    made = len(drawn)
    if made > most:
        drawn = [drawn[n] for n in sorted(random.Random(seed).sample(range(made), most))]
    if in_a_fork(lambda: run_tests(module, ast.parse(source)), 10.0 * seconds) != 0:
        raise SystemExit(f"{module}: its tests fail without a mutant")
    began_s, fates = time.monotonic(), []
    for mutant in drawn:
        fates.append(fate(module, mutant, seconds))
        if fates[-1] == SURVIVED:
            text = source.splitlines()[mutant.line - 1].strip()
            print(f"  {module}:{mutant.line}: {mutant.change}: {text}", flush=True)
    survived = fates.count(SURVIVED)
    killed = len(drawn) - survived
    print(
        f"{module}: {killed} of {len(drawn)} mutants killed, {100.0 * killed / len(drawn):.1f} % "
        f"({fates.count(TIMED_OUT)} by time; {made} in all; {time.monotonic() - began_s:.0f} s)",
        flush=True,
    )


def show_branches(module: str, seconds: float) -> None:
    """Print which branches of a module its tests do not take."""
    source = (ROOT / module).read_text(encoding="utf-8")

    def run() -> int:
        branches = Branches(str(ROOT / module), source)
        tree, out = ast.parse(source), os.dup(1)
        with branches.watched():
            code = run_tests(module, tree)
        os.dup2(out, 1)
        for line in branches.report(module):
            print(line, flush=True)
        return code

    if in_a_fork(run, 20.0 * seconds) != 0:
        raise SystemExit(f"{module}: its tests fail while branches are watched")


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", default=list(TESTS), metavar="MODULE", help="one of TESTS")
    parser.add_argument("--most", type=int, default=150, help="mutants of a module at most")
    parser.add_argument("--seed", type=int, default=1, help="draws them where there are more")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long the tests of a mutant may take")
    parser.add_argument("--branches", action="store_true", help="print branches that are not taken instead")
    stated = parser.parse_args()
    unknown = [module for module in stated.modules if module not in TESTS]
    if unknown:
        parser.error(f"there are no tests for {', '.join(unknown)}; there are {', '.join(TESTS)}")
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    for name in LOADED_BEFORE:
        importlib.import_module(name)
    for module in stated.modules:
        if stated.branches:
            show_branches(module, stated.seconds)
        else:
            score(module, stated.most, stated.seed, stated.seconds)


if __name__ == "__main__":
    main()
