"""How much of all compile time the last commits threw away, by the key of `noise_model.compiled.content`.

    python benchmarks/recompiled.py 80

Nothing is compiled. In the tree of each commit the content of every kernel is described, with the records
that its annotations name. A kernel is compiled anew if that is another than a commit before, or that of a
short one that it calls. How long each takes, and which are long, is read off this user's cache: run
`ARCTRACK_PACKS=/nowhere arctrack warm` before. A kernel that is not there, of an older commit, counts by the
size of its bytecode.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import pickle
import re
import subprocess
import sys
import tempfile
import typing
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("noise_model", "tracker", "calibration", "robot_io", "sim_to_real", "arctrack")
COMPILER = ("compiled.callee", "compiled.numba_internals", "linking", "entry")
LONG_BYTES = 600
"""A kernel that the cache does not know is long from so many bytes of bytecode on."""


def main(n_commits: int) -> None:
    """Print the share of compile time that each commit threw away, and their mean."""
    git = ["git", "-C", str(ROOT)]
    log = [*git, "log", "--first-parent", f"-{n_commits + 1}", "--format=%h %s"]
    commits = subprocess.run(log, capture_output=True, text=True, check=True).stdout.splitlines()[::-1]
    seconds, long_names = measured()
    before: dict[str, Any] | None = None
    shares = []
    for commit in commits:
        with tempfile.TemporaryDirectory() as folder:
            archive = [*git, "archive", commit.split()[0], *PACKAGES]
            packed = subprocess.run(archive, capture_output=True, check=True).stdout
            subprocess.run(["tar", "x", "-C", folder], input=packed, check=True)
            describe = [sys.executable, __file__, "--describe"]
            told = subprocess.run(describe, cwd=folder, capture_output=True, text=True, check=True).stdout
        kernels = json.loads(told.splitlines()[-1])
        if before is not None:
            shares.append(share_thrown_away(before, kernels, seconds, long_names))
            print(f"{100.0 * shares[-1]:5.1f} %  {commit}", flush=True)
        before = kernels
    touched = [share for share in shares if share > 0.0] or [0.0]
    print(f"mean of {len(shares)} commits {100.0 * np.mean(shares):.1f} %,", end=" ")
    print(f"of the {len(touched)} that change a kernel {100.0 * np.mean(touched):.1f} %")


def measured() -> tuple[dict[str, float], set[str]]:
    """Return the seconds that kernels took by name, and the names of those that callers call by symbol."""
    from noise_model.compiled.store import kernel_folder, read_records

    seconds, long_names = {}, set()
    of_project = (
        folder for package in PACKAGES for folder in (kernel_folder() or Path()).glob(f"{package}.*")
    )
    for folder in of_project:
        records = list(read_records(folder.name, ""))
        seconds[folder.name] = max((record.compile_s for record in records), default=0.0)
        for record in records:
            # Of another tree: a class that is not here.
            with suppress(AttributeError, ImportError):
                own = pickle.loads(record.body)[0]
                if getattr(own, "content", None) == "":
                    long_names.add(folder.name)
    return seconds, long_names


def share_thrown_away(
    before: dict[str, Any], now: dict[str, Any], seconds: dict[str, float], long_names: set[str]
) -> float:
    """Return the share of the compile time of all kernels that are there now, in those that changed."""
    known_s = sum(seconds.get(name, 0.0) for name in now)
    known_bytes = sum(kernel["bytes"] for name, kernel in now.items() if name in seconds)
    changed: dict[str, bool] = {}

    def is_changed(name: str) -> bool:
        if name not in changed:
            changed[name] = False
            was = before.get(name, {}).get("content")
            changed[name] = was != now[name]["content"] or any(
                is_changed(callee) for callee in now[name]["calls"] if callee in now and not is_long(callee)
            )
        return changed[name]

    def is_long(name: str) -> bool:
        known = name in long_names if name in seconds else now[name]["bytes"] >= LONG_BYTES
        return known and not now[name]["inline"]

    weight = {
        name: seconds.get(name, known_s * kernel["bytes"] / known_bytes) for name, kernel in now.items()
    }
    return sum(weight[name] for name in now if is_changed(name)) / sum(weight.values())


def describe_tree() -> None:
    """Print the content, the callees and the size of each kernel of the tree in the working folder."""
    sys.path.insert(0, str(Path.cwd()))
    spec = importlib.util.spec_from_file_location("content", ROOT / "noise_model/compiled/content.py")
    assert spec is not None
    assert spec.loader is not None
    content = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(content)
    # What of the compiler was in files of its own before belongs to the key as well.
    compiler = [
        content._source(f"noise_model.{name}")
        for name in COMPILER
        if Path("noise_model", *name.split(".")).with_suffix(".py").exists()
        and importlib.import_module(f"noise_model.{name}")
    ]
    kernels = {}
    for file in sorted(file for package in PACKAGES for file in Path(package).rglob("*.py")):
        if re.search(r"^@kernel", file.read_text(), re.M):
            module = importlib.import_module(".".join(file.with_suffix("").parts))
            for value in list(vars(module).values()):
                if content.is_jitted(value) and value.py_func.__module__ == module.__name__:
                    name = f"{module.__name__}.{value.py_func.__qualname__}"
                    kernels[name] = described(content, value, compiler)
    print(json.dumps(kernels))


def described(content: Any, kernel: Any, compiler: list[Any]) -> dict[str, Any]:
    """Return a kernel's content with the records of its annotations, what it calls, and its size."""
    hints = typing.get_type_hints(kernel.py_func)
    text = repr((content._Description().kernel(kernel), [record(hint) for hint in hints.values()], compiler))
    options = kernel.targetoptions
    return {
        "content": content.digest(text),
        "calls": [".".join(named) for named in re.findall(r"\('kernel', '([\w.]+)', '(\w+)'\)", text)],
        "bytes": len(kernel.py_func.__code__.co_code),
        "inline": options.get("inline") == "always" or bool(options.get("forceinline")),
    }


def record(hint: Any) -> Any:
    """Return the fields of a record that an annotation names, and of those within it."""
    if inspect.isclass(hint) and hasattr(hint, "_fields"):
        return hint.__qualname__, [(name, record(part)) for name, part in typing.get_type_hints(hint).items()]
    return [record(part) for part in typing.get_args(hint)] or str(hint)


if __name__ == "__main__":
    describe_tree() if sys.argv[1] == "--describe" else main(int(sys.argv[1]))
