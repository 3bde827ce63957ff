import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from made import noise_frames

import arctrack
from arctrack.recording import read_recording

ROOT = Path(__file__).resolve().parents[2]


def test_every_name_of_the_facade_is_there() -> None:
    assert arctrack.read_recording is read_recording
    for name in arctrack.__all__:
        assert getattr(arctrack, name) is not None
        assert name in dir(arctrack)


def test_other_names_are_not() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        arctrack.nonsense  # noqa: B018


def test_the_version_is_that_of_the_distribution() -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert arctrack.__version__ == stated


def test_importing_it_loads_nothing_heavy() -> None:
    heavy = "{'numpy', 'numba', 'cv2', 'matplotlib', 'rich'} & set(sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys, arctrack; print({heavy})"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "set()\n"


def test_every_package_in_the_wheel_is_typed() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    packages = build["targets"]["wheel"]["packages"]
    assert set(packages) == {path.parent.name for path in ROOT.glob("*/py.typed")}
    found = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert set(packages) == found - {"tests", "validation"}


def test_paths_may_be_text(recording: Path, tmp_path: Path) -> None:
    toml = str(recording / "recording.toml")
    read = arctrack.read_recording(str(recording), toml)
    assert arctrack.read_setup_file(toml).path == read.setup_path == recording / "recording.toml"
    assert arctrack.read_truth(str(recording)) is None
    options = arctrack.ReplayOptions(pictures=False)
    assert arctrack.replay_recording(read, str(tmp_path / "out"), options).folder == tmp_path / "out"
    frames = noise_frames(read.setup, 2)
    with arctrack.RecordingWriter(str(tmp_path / "new"), read.setup) as writer:
        writer.write_frame(frames[0])
    assert (tmp_path / "new" / "frames.csv").exists()


def test_what_holds_a_setup_is_no_setup(recording: Path, tmp_path: Path) -> None:
    stated = arctrack.read_setup_file(recording / "recording.toml")
    with pytest.raises(TypeError, match=r"^a Setup is needed, not a SetupFile: give its \.setup$"):
        arctrack.Tracker(stated)
    with pytest.raises(TypeError, match=r"not a Recording: give its \.setup$"):
        arctrack.Tracker(arctrack.read_recording(recording))
    for path in (recording, str(recording)):
        with pytest.raises(TypeError, match=r"^a Setup is needed, .*read_setup_file\(path\)\.setup is one"):
            arctrack.Tracker(path)
    with pytest.raises(TypeError, match=r"give its \.setup"):
        arctrack.simulate_recording(tmp_path / "s", stated)
    with pytest.raises(TypeError, match=r"give its \.setup"):
        arctrack.RecordingWriter(tmp_path / "s", stated)
    assert not list(tmp_path.iterdir())


def test_a_path_is_no_recording(recording: Path) -> None:
    with pytest.raises(TypeError, match=r"^a Recording is needed, not a str: read_recording\(path\) is one$"):
        arctrack.replay_recording(str(recording))


@pytest.mark.parametrize(
    ("joint", "material", "message"),
    [
        ("vgroove", "mild_steel", "there is no joint 'vgroove': did you mean 'v_groove'?"),
        ("V-Groove", "mild_steel", "there is no joint 'V-Groove': did you mean 'v_groove'?"),
        (
            "zigzag",
            "mild_steel",
            "there is no joint 'zigzag': there are v_groove, lap, corrugation, butt, fillet, half_v, "
            "u_groove, edge, outside_corner",
        ),
        ("lap", "mildsteel", "there is no material 'mildsteel': did you mean 'mild_steel'?"),
    ],
)
def test_a_nominal_setup_that_there_is_not(joint: str, material: str, message: str) -> None:
    with pytest.raises(arctrack.ArctrackError) as refusal:
        arctrack.nominal_setup(joint, material)
    assert str(refusal.value) == message
