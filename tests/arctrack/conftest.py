from pathlib import Path

import pytest

from arctrack.nominal import nominal_setup
from arctrack.simulate import SimulationPlan, balance, simulate_recording
from noise_model.setup import Setup


@pytest.fixture(scope="session")
def seen_setup() -> Setup:
    """Return a V-groove under a small camera: quick to render, fine enough to track."""
    return balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory, seen_setup: Setup) -> Path:
    """Return a recording with its truth; tests copy it before they spoil it."""
    path = tmp_path_factory.mktemp("simulated") / "v"
    return simulate_recording(path, seen_setup, SimulationPlan(frames=14, tilt_deg=2.0))
