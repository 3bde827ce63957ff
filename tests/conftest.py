import importlib.util
import os
from pathlib import Path
from typing import Any

import can
import pytest
from documented import compile_kernels, make_scratch
from hypothesis import settings
from once import once

# How long an example takes depends on the machine and on what is compiled first. The same code gives the same
# verdict; other examples than always the same are drawn with --hypothesis-profile explore.
settings.register_profile("explore", deadline=None, derandomize=False)
settings.register_profile("arctrack", deadline=None, derandomize=True)
settings.load_profile("arctrack")


def pytest_configure() -> None:
    """Let workers, and the commands that tests start, compute by one thread each.

    Threads of BLAS wait for each other by turning in circles. Where all processors are at work, that took
    three quarters of the time of a hand-eye calibration.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")


COMPILE_NOTHING = ("tests/robot_io/", "tests/test_", "tests/docs/test_site.py")
"""How the names of tests begin that need no kernel, though they take a minute."""

LAST = "tests/calibration/"
"""How the names of many short tests begin: with them all workers come to their end together."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as quick whatever is not marked slow, before `-m` chooses; begin with what compiles nothing.

    The first of several workers gets it, the next ones begin to compile. What needs all kernels comes when
    others have compiled them.
    """
    for item in items:
        if item.get_closest_marker("slow") is None:
            item.add_marker("quick")
    items.sort(key=_turn)


def _turn(item: pytest.Item) -> int:
    """Return when a test has its turn."""
    if item.nodeid.startswith(COMPILE_NOTHING):
        return 0
    if "compiled" in getattr(item, "fixturenames", ()):
        return 2
    return 3 if item.nodeid.startswith(LAST) else 1


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that all workers of this run share; see `once`."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session")
def compiled(shared: Path) -> None:
    """Compile in one of several workers what processes need that tests start: they take no turns."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        once(shared, "compiled", compile_kernels)


@pytest.fixture
def scratch(compiled: None, tmp_path: Path) -> Path:
    """Return a folder in which commands of the documentation can be run; see `documented`."""
    make_scratch(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def mitsuba() -> Any:
    """Return Mitsuba; where it cannot start, what needs it is skipped and says so."""
    from validation.second_renderer.path_traced import load_mitsuba

    try:
        return load_mitsuba()
    except ImportError as error:
        pytest.skip(f"no Mitsuba to cast rays or trace paths with: {error}")


@pytest.fixture(scope="session")
def multicast() -> dict[str, Any]:
    """Return the options of a bus that other processes can join; a machine without multicast skips."""
    if importlib.util.find_spec("msgpack") is None:
        pytest.skip("msgpack is not installed")
    # A port of this process: other runs on the same machine must not be heard.
    port = 20_000 + os.getpid() % 20_000
    bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "port": port, "hop_limit": 0}
    try:
        with can.Bus(**bus, ignore_config=True) as one, can.Bus(**bus, ignore_config=True) as other:
            one.send(can.Message(arbitration_id=0x700, data=b"", is_extended_id=False))
            if other.recv(0.5) is None:
                pytest.skip("multicast frames do not arrive on this machine")
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast on this machine: {error}")
    return bus
