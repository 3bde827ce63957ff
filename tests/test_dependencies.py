"""The locks hold what pyproject.toml states: every pin hashed, the oldest lock at the stated lower bounds.

What is installed is enough to import every module.
"""

from __future__ import annotations

import importlib
import pkgutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
STATED = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = {"requirements.lock": (), "requirements-dev.lock": ("dev",), "requirements-oldest.lock": ("test",)}

IN_NO_LOCK = {"rerun"}
"""What a module imports that only an extra brings which no lock holds."""


class Pin(NamedTuple):
    """One line of a lock."""

    name: str
    version: Version
    hashes: tuple[str, ...]


def pins(lock: str) -> list[Pin]:
    lines = (ROOT / lock).read_text().replace("\\\n", " ").splitlines()
    entries = [line for line in lines if line and not line.startswith("#")]
    return [pin(*entry.split(" --hash=")) for entry in entries]


def pin(requirement: str, *hashes: str) -> Pin:
    locked = Requirement(requirement)
    (specifier,) = locked.specifier
    assert specifier.operator == "=="
    return Pin(canonicalize_name(locked.name), Version(specifier.version), hashes)


def stated(extras: tuple[str, ...]) -> Iterator[Requirement]:
    """Yield what arctrack needs to be built and run, and what these extras add."""
    project = STATED["project"]
    lines = [
        *project["dependencies"],
        *STATED["build-system"]["requires"],
        *STATED["dependency-groups"]["build"],
    ]
    for line in lines + [line for extra in extras for line in project["optional-dependencies"][extra]]:
        requirement = Requirement(line)
        if requirement.name == project["name"]:
            yield from stated(tuple(sorted(requirement.extras)))
        else:
            yield requirement


@pytest.mark.parametrize("lock", EXTRAS)
def test_every_pin_of_a_lock_has_hashes_and_no_source_of_its_own(lock: str) -> None:
    assert "://" not in (ROOT / lock).read_text()
    for locked in pins(lock):
        assert locked.hashes, locked.name
        assert all(digest.strip().startswith("sha256:") for digest in locked.hashes)


@pytest.mark.parametrize("lock", EXTRAS)
def test_a_lock_pins_all_that_is_stated(lock: str) -> None:
    locked = pins(lock)
    for requirement in stated(EXTRAS[lock]):
        versions = [pin.version for pin in locked if pin.name == canonicalize_name(requirement.name)]
        assert versions, f"{requirement.name} is not in {lock}: run .ci/lock"
        assert all(requirement.specifier.contains(version) for version in versions), requirement


def test_the_oldest_lock_pins_the_lower_bounds_themselves() -> None:
    oldest = {pin.name: pin.version for pin in pins("requirements-oldest.lock")}
    for requirement in stated(EXTRAS["requirements-oldest.lock"]):
        (bound,) = (Version(s.version) for s in requirement.specifier if s.operator in (">=", "=="))
        assert oldest[canonicalize_name(requirement.name)] == bound, requirement


def test_the_development_lock_runs_what_the_other_lock_runs() -> None:
    assert {locked[:2] for locked in pins("requirements.lock")} <= {
        locked[:2] for locked in pins("requirements-dev.lock")
    }


def test_every_module_can_be_imported() -> None:
    for package in STATED["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        for module in pkgutil.walk_packages([str(ROOT / package)], f"{package}."):
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as missing:
                assert missing.name in IN_NO_LOCK, module.name  # noqa: PT017
