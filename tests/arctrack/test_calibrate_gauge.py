import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from calibrate_commands import EXAMPLES, command, copied_setup

from arctrack.errors import ArctrackError
from arctrack.recording import read_setup_file

sys.path.append(str(Path(__file__).parents[2] / "examples"))

import make_gauge

pytestmark = pytest.mark.slow

calibrate = command("gauge")
V = ["--gauge", "v:90deg:5mm"]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of seven of the example's pictures with their poses."""
    folder = tmp_path_factory.mktemp("gauge")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make_gauge, "POSES", [make_gauge.POSES[n] for n in (0, 1, 3, 4, 5, 7, 8)])
        make_gauge.main(folder)
    return folder


@pytest.fixture
def setup_toml(tmp_path: Path) -> Path:
    return copied_setup(tmp_path)


def test_pictures_of_a_gauge_become_a_sheet_in_the_setup(pictures: Path, setup_toml: Path) -> None:
    stated = setup_toml.read_text().replace(
        "plane_in_tool = [1.0, 0.0, 0.0, -35.0]", "plane_in_tool = [0.9998, 0.0, 0.02, -35.5] # bought so"
    )
    setup_toml.write_text(stated)
    result = calibrate(pictures, *V, "--poses", pictures / "poses.csv", "--setup", setup_toml)
    assert result.exit_code == 0, result.output
    assert "the one before is recording.toml.1" in result.output
    setup = read_setup_file(setup_toml).setup
    record = tomllib.loads(setup_toml.read_text())["calibration"]["laser"]
    assert record["made_by"] == "arctrack calibrate gauge"
    assert np.abs((setup.laser.plane - make_gauge.SHEET_IN_TOOL)[2:] / record["sigma"][2:]).max() < 4.0
    assert record["sigma"][3] < 0.2
    assert setup.laser.origin_mm @ setup.laser.plane[:3] + setup.laser.plane[3] == pytest.approx(
        0.0, abs=1e-3
    )
    page = (setup_toml.parent / "calibrate_gauge.html").read_text()
    assert page.count("data:image") == 3


def test_a_check_says_ok_or_what_to_calibrate_anew(pictures: Path, setup_toml: Path) -> None:
    before = setup_toml.read_text()
    image = pictures / "gauge_00.png"
    result = calibrate(image, *V, "--setup", setup_toml, "--check")
    assert result.exit_code == 0, result.output
    assert "OK: the gauge's 5 mm are measured" in result.output
    assert setup_toml.read_text() == before
    wrong = before.replace(
        "plane_in_tool = [1.0, 0.0, 0.0, -35.0]", "plane_in_tool = [0.995, 0.0, 0.1, -35.0]"
    )
    setup_toml.write_text(wrong)
    result = calibrate(image, *V, "--setup", setup_toml, "--check")
    assert result.exit_code == 1, result.output
    assert "not OK: the gauge's 5 mm are measured" in result.output
    assert "`arctrack calibrate laser`" in result.output


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--gauge", "v:90deg"], "--gauge: 'v:90deg' is no gauge: it is written as step:HEIGHTmm"),
        ([*V, "--out", "x.toml", "--check"], "--out: --check writes no setup"),
        ([*V, "--rotation", "kuka"], "--rotation, --units: have no effect without --poses"),
        ([*V, "--check", "--within", "0.001"], "too little to tell 0.001 mm"),
        ([*V, "--check", "--report", "gauge_00.png"], "gauge_00.png: is one of the images"),
        (["--gauge", "step:50mm", "--check"], "no image shows the gauge"),
        (V, "the robot's poses are unknown: give them with --poses"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(
    pictures: Path, setup_toml: Path, words: list[str], why: str
) -> None:
    at = [str(pictures / word) if word.endswith(".png") else word for word in words]
    result = calibrate(pictures / "gauge_00.png", *at, "--setup", setup_toml)
    assert isinstance(result.exception, ArctrackError)
    assert why in str(result.exception)


def test_a_recordings_groove_is_a_v_of_its_own_angle(tmp_path: Path) -> None:
    """The example's groove has 60 deg, and its flanks meet 4.87 mm deep."""
    page = "--report", tmp_path / "page.html"
    result = calibrate(EXAMPLES / "v_groove", "--gauge", "v:60deg:4.866mm", "--check", *page)
    assert "OK: the gauge's 4.866 mm are measured" in result.output
    result = calibrate(EXAMPLES / "v_groove", *V, "--check", *page)
    assert "across, the gauge's has 90°" in str(result.exception)


def test_help_has_an_example() -> None:
    assert "Example: arctrack calibrate gauge /tmp/gauge" in calibrate("--help").output
