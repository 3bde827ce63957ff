"""Machine code on disk is used again while its sources are what they were, and only then."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

INNER = (
    "from noise_model.kernel import kernel\n\n\n@kernel({options})\ndef inner(x):\n    return {value} * x\n"
)
OUTER = (
    "from noise_model.kernel import kernel\nfrom optics_of_a_test.{module} import inner\n\n\n"
    "@kernel\ndef outer(x):\n    return inner(x) + 1.0\n"
)
RUN = (
    "from optics_of_a_test.outer import outer\n"
    "result = outer(2.0)\n"
    "print(result, sum(outer.stats.cache_hits.values()), sum(outer.stats.cache_misses.values()))\n"
)


def write(package: Path, options: str, value: float) -> None:
    """Write two kernels, one that calls the other, with times and sizes that tell nothing."""
    package.mkdir(exist_ok=True)
    sources = {
        "__init__.py": "",
        "inner.py": INNER.format(options=options, value=value),
        "outer.py": OUTER.format(module="inner"),
        "beside.py": f"# {value}\n",
    }
    for name, source in sources.items():
        (package / name).write_text(source)
        os.utime(package / name, (1e9, 1e9))


def run(folder: Path) -> tuple[float, int, int]:
    """Return the outer kernel's result and how often it was found on disk, and compiled, in a new process."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}:{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", RUN], capture_output=True, text=True, check=True, env=environment
    )
    result, hits, misses = done.stdout.split()
    return float(result), int(hits), int(misses)


@pytest.mark.slow
@pytest.mark.parametrize("options", ["inline=True", ""], ids=["written out", "linked"])
def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(options: str, tmp_path: Path) -> None:
    package = tmp_path / "optics_of_a_test"
    write(package, options, 3.0)
    assert run(tmp_path) == (7.0, 0, 1)
    assert run(tmp_path) == (7.0, 1, 0)
    write(package, options, 5.0)
    assert run(tmp_path) == (11.0, 0, 1)
    assert run(tmp_path) == (11.0, 1, 0)


@pytest.mark.slow
def test_what_a_kernel_does_not_import_leaves_it_alone(tmp_path: Path) -> None:
    package = tmp_path / "optics_of_a_test"
    write(package, "", 3.0)
    run(tmp_path)
    (package / "beside.py").write_text("# another thing\n")
    assert run(tmp_path) == (7.0, 1, 0)


@pytest.mark.slow
def test_a_record_that_an_update_has_moved_is_compiled_for_anew(tmp_path: Path) -> None:
    """What is kept names the old module, which is gone."""
    package = tmp_path / "optics_of_a_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    record = "from typing import NamedTuple\n\n\nclass Lens(NamedTuple):\n    f_mm: float\n"
    for module in ("old", "new"):
        (package / f"{module}.py").write_text(record)
        (package / "outer.py").write_text(
            f"from noise_model.kernel import kernel\nfrom optics_of_a_test.{module} import Lens\n\n\n"
            "@kernel\ndef of_lens(lens):\n    return 2.0 * lens.f_mm\n\n\n"
            "def outer(x):\n    return of_lens(Lens(x))\n\n\nouter.stats = of_lens.stats\n"
        )
        assert run(tmp_path) == (4.0, 0, 1)
        (package / "old.py").unlink(missing_ok=True)
