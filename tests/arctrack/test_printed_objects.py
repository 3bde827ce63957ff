"""Public objects on a screen: one to three short lines, with units."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import level_pose

import arctrack
from arctrack.nominal import nominal_setup
from noise_model.setup import Setup
from tracker.state import Frame, Pose, Track


@pytest.fixture(scope="module")
def setup() -> Setup:
    return nominal_setup("v_groove", "mild_steel")


def test_a_setup_and_its_parts(setup: Setup) -> None:
    assert str(setup).splitlines() == [
        "v_groove: included_angle_deg 60, depth_mm 4, root_gap_mm 1; nominal seam 1100 mm long",
        "of mild_steel: kappa_diff 0.021, kappa_spec 0.326, c2 112",
        "camera 640 x 480 px, 8 bit, 5 ms; laser 690 nm; arc 100 A",
    ]
    assert str(replace(setup, effects={"gamma": {"gamma": 0.8}})).splitlines()[1].endswith("effects: gamma")
    assert str(setup.camera) == (
        "640 x 480 px, 16.2 mm f/8, field 16.6 x 12.5 deg, PSF 0.7 px; "
        "at (95.0, 0.0, 130.0) mm in tool, 24.4 deg off straight down"
    )
    assert str(setup.sensor).endswith("full well 20400 e-, gamma 1")
    assert str(setup.laser).startswith("690 nm, plane [1 0 0 -35] in tool, stripe sigma 0.45 mm")
    assert str(setup.arc) == "hemisphere of 3 mm, radiance 1 e- at 100 A, ~ current^1.3"
    assert str(setup.tolerance).endswith("the weld bears 0.25 mm")
    assert "\x1b" not in str(replace(setup.material, name="\x1b[31m"))


def test_a_frame_a_pose_and_a_track() -> None:
    frame = Frame(12, 1.2, np.zeros((480, 640), np.uint8), 0.005, 100.0)
    assert str(frame) == "frame 12 at 1.200 s: 640 x 480 px uint8, laser and arc at 100 A, 5 ms"
    dark = replace(frame, laser_on=False, arc_on=False)
    assert str(dark) == "frame 12 at 1.200 s: 640 x 480 px uint8, no light, 5 ms"
    pose = Pose(level_pose(1.0), extrapolated=True)
    assert repr(pose) == "Pose(tool at (8.00, 0.00, 1.00) mm in base, 0.0 deg off its z, extrapolated)"
    assert str(Track(3, 0.3, 1)).startswith("track of frame 3 at 0.300 s: no seam; flags: ")
    track = Track(3, 0.3, 0, (35.0, 0.12, -4.0), 0.02, 0.03, 0.11, -0.2, confidence=0.987)
    assert str(track).splitlines() == [
        "track of frame 3 at 0.300 s: seam y +0.120 ± 0.020, z -4.000 ± 0.030 mm in tool",
        "offset y +0.110, z -0.200 mm; confidence 0.99; flags: none",
    ]


def test_what_is_read_and_replayed(simulated: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(simulated, tmp_path / "v"))
    read = arctrack.read_recording(path)
    count = len(read.poses.timestamps_s)
    assert repr(read) == f"Recording(v: 14 frames and {count} poses of a v_groove in mild_steel)"
    assert repr(read.poses).startswith(f"PoseTable({count} poses from -0.4")
    assert repr(read.poses).endswith("s, of poses.csv)")
    stated = arctrack.read_setup_file(path / "recording.toml")
    assert repr(stated) == f"SetupFile({path}/recording.toml: a v_groove in mild_steel)"
    assert repr(arctrack.read_truth(path)).startswith("Truth(14 seam points, y ")
    tracker = arctrack.Tracker(read.setup)
    assert repr(tracker) == "Tracker(a v_groove seen by 160 x 120 px, with the arc map; 0 frames so far)"
    replay = arctrack.replay_recording(read, tmp_path / "out", arctrack.ReplayOptions(pictures=False))
    counts = "8 of 8 offsets sent; 9 of 9 frames with the laser on are valid"
    assert str(replay.summary).startswith(f"v: {counts}, RMS error ")
    assert repr(replay) == f"Replay({replay.summary}; results in {tmp_path}/out)"
