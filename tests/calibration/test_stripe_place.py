"""The part of a setup that is off is named by stripes of turned poses, and left open by those of one pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from arctrack.calibrate.check.place_measures import first_suspect, place_sentences, suspects
from arctrack.nominal import nominal_setup
from calibration.check.stripe_place import (
    StripePlace,
    StripeSight,
    locate_stripes,
    with_changes,
)
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import moved
from tracker.geometry import SensorGeometry
from tracker.stripe.expected import expect_stripe

pytestmark = pytest.mark.slow

SETUP = nominal_setup("fillet", "mild_steel", width=320, height=240)
LYING = SeamLine(y_mm=0.3, z_mm=0.5)
NOISE_PX = 0.2


def poses(turn_deg: float, lift_mm: float) -> list[Float64]:
    rng = np.random.default_rng(3)
    level = np.eye(4)
    level[2, 3] = 1.0
    return [
        moved(level, [*rng.uniform(-turn_deg, turn_deg, 2), 0.0], [5.0 * n, 0.0, rng.uniform(0.0, lift_mm)])
        for n in range(5)
    ]


def placed(change: Mapping[str, float], tool: list[Float64]) -> StripePlace:
    """Return what the nominal setup says of stripes that a changed one makes."""
    rng = np.random.default_rng(1)
    geometry = SensorGeometry.of(with_changes(SETUP, change))
    sights = []
    for T_base_tool in tool:
        stripe = expect_stripe(geometry, make_scene(geometry.setup, T_base_tool, LYING))
        assert stripe is not None
        position_px = stripe.position_px + rng.normal(0.0, NOISE_PX, geometry.n_scan)
        scan = np.arange(geometry.n_scan, dtype=np.float64)
        sights.append(StripeSight(geometry.image_points(scan, position_px), T_base_tool))
    return locate_stripes(SETUP, sights)


def test_a_sound_setup_explains_stripes_of_a_part_off_its_place() -> None:
    place = placed({}, poses(5.0, 10.0))
    assert place.is_explained
    assert place.likely == ()
    assert place.rms_px < 2.0 * NOISE_PX
    seam = place.seam_by(place.best)
    assert (seam.y_mm, seam.z_mm) == pytest.approx((LYING.y_mm, LYING.z_mm), abs=0.3)


@pytest.mark.parametrize(
    ("change", "suspect"),
    [
        ({"camera_rot_x": 0.8, "camera_rot_y": 1.0}, "hand-eye"),
        ({"laser_rot_2": 0.4, "laser_offset": 1.5}, "laser plane"),
    ],
)
def test_turned_poses_name_what_is_off(change: Mapping[str, float], suspect: str) -> None:
    place = placed(change, poses(5.0, 10.0))
    assert suspects(place) == (suspect,)


def test_one_pose_names_the_hand_eye_first_and_what_it_cannot_be_told_from() -> None:
    place = placed({"sensor_z": 25.0}, poses(0.0, 0.0))
    assert not place.is_explained
    assert first_suspect(place) == "hand-eye"
    assert "part" in suspects(place)
    assert "the tool turned by 5°" in " ".join(place_sentences(place))


def test_a_plane_is_turned_and_moved_as_stated() -> None:
    moved_setup: Setup = with_changes(SETUP, {"laser_offset": 2.0, "laser_rot_2": 1.0})
    before, after = SETUP.laser.plane, moved_setup.laser.plane
    assert np.degrees(np.arccos(before[:3] @ after[:3])) == pytest.approx(1.0, abs=1e-6)
    assert after[:3] @ SETUP.laser.point_mm + after[3] == pytest.approx(-2.0)


def test_nothing_in_the_laser_plane_is_refused() -> None:
    far = StripeSight(np.array([[1e6, 1e6]] * 40), np.eye(4))
    with pytest.raises(ValueError, match="no stripe meets the laser plane"):
        locate_stripes(SETUP, [far])
