import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import CHROMIUM, Page
from made import UNREADABLE, noise_frames, small_setup, write
from spoiled import Refusal

from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from noise_model.setup import Setup


@pytest.fixture(scope="session", autouse=True)
def speaks_often() -> Iterator[None]:
    """Let commands say how far they are as often as on a slow machine: no test may stumble over it."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("arctrack.cli.console.SPOKEN_EVERY_S", 0.001)
        yield


@pytest.fixture(scope="session")
def seen_setup() -> Setup:
    """Return a V-groove under a small camera: quick to render, fine enough to track."""
    return balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory, seen_setup: Setup) -> Path:
    """Return a recording with its truth; tests copy it before they spoil it."""
    path = tmp_path_factory.mktemp("simulated") / "v"
    return simulate_recording(path, seen_setup, SimulationPlan(frames=14, tilt_deg=2.0))


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of four frames of noise; tests copy it before they spoil it."""
    setup = small_setup()
    return write(tmp_path_factory.mktemp("good") / "r", setup, noise_frames(setup, 4))


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Yield a browser's page."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    with Page(tmp_path_factory.mktemp("chromium")) as page:
        yield page


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Refusal:
    """Return what runs a command and gives the line that it is refused with."""
    return Refusal(capsys, monkeypatch)


@pytest.fixture(scope="session")
def flawed_recording(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording that begins before 0 s and has a frame that cannot be read."""
    path = Path(shutil.copytree(simulated, tmp_path_factory.mktemp("export") / "r"))
    lines = (path / "frames.csv").read_text().splitlines()
    assert lines[1].startswith("0,0.000000,")
    lines[1] = lines[1].replace("0,0.000000,", "0,-0.100000,")
    (path / "frames.csv").write_text("\n".join(lines))
    frame = path / "frames" / f"{UNREADABLE:06d}.png"
    frame.write_bytes(frame.read_bytes()[:500])
    return path
