"""The arc's height from its light: arcs that stand elsewhere, on metal that is not the stated one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from arctrack.replay.arc_height import ArcHeight, ArcHeightEstimator, arc_above_surface
from arctrack.simulation.simulate import balance
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from noise_model.surface.joint import SeamLine
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose, Track

pytestmark = pytest.mark.slow

SEAM_SIGMA_MM = 0.2, 0.2


def estimated(joint: str, seed: int) -> tuple[float, ArcHeight]:
    """Return a true height and its estimate: the metal's lobe, the arc's size and place are off as well."""
    rng = np.random.default_rng(seed)
    setup = balance(nominal_setup(joint, "mild_steel", width=320, height=240))
    height_mm = rng.uniform(-1.0, 2.0)
    effects = {
        "arc_length": {"height_mm": height_mm},
        "roughness_change": {"c2_ln": rng.normal(0.0, 0.1)},
        "arc_radius": {"radius_ratio": rng.normal(1.0, 0.05)},
        "arc_deflection": {"x_mm": rng.normal(0.0, 0.3), "y_mm": rng.normal(0.0, 0.3)},
    }
    pose = np.eye(4)
    pose[:3, 3] = 60.0 + rng.uniform(0.0, 5.0), 0.0, 1.0
    # The plate lies farther aside, and higher or lower, than its seam is known.
    seam = SeamLine(y_mm=rng.normal(0.0, SEAM_SIGMA_MM[0]), z_mm=rng.normal(0.0, SEAM_SIGMA_MM[1]))
    lit = Condition(0.0, 1.2, setup.camera.exposure_s)
    image = draw_frame(replace(setup, effects=effects), pose, lit, rng, seam=seam)
    frame = Frame(0, 0.0, image, setup.camera.exposure_s, laser_on=False)
    estimator = ArcHeightEstimator(SensorGeometry.of(setup))
    return height_mm, estimator.estimate(frame, Pose(pose), SeamLine(), None, 0.0, SEAM_SIGMA_MM)


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_heights_are_within_their_sigma(joint: str) -> None:
    worlds = [estimated(joint, seed) for seed in range(8)]
    z = np.array([(height.height_mm - true_mm) / height.height_sigma_mm for true_mm, height in worlds])
    assert np.isfinite(z).all()
    assert np.sqrt((z**2).mean()) < 1.5
    assert max(height.height_sigma_mm for _, height in worlds) < 0.6
    # The heights themselves differ by more.
    assert np.ptp([true_mm for true_mm, _ in worlds]) > 1.5
    levels = [(height.level - 1.2) / height.level_sigma for _, height in worlds]
    assert np.sqrt(np.mean(np.square(levels))) < 2.0


def test_an_arc_that_is_hidden_says_nothing() -> None:
    setup = balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))
    image = np.zeros((120, 160), np.uint8)
    estimator = ArcHeightEstimator(SensorGeometry.of(setup))
    frame = Frame(0, 0.0, image, setup.camera.exposure_s, laser_on=False)
    pose = np.eye(4)
    pose[:3, 3] = 60.0, 0.0, 1.0
    height = estimator.estimate(frame, Pose(pose), SeamLine(), None, 0.0, SEAM_SIGMA_MM)
    assert np.isnan(height.height_mm)


def test_a_track_that_knows_no_arc_or_no_stripe_tells_no_height() -> None:
    setup = balance(nominal_setup("v_groove", "mild_steel", width=160, height=120))
    estimator = ArcHeightEstimator(SensorGeometry.of(setup))
    rng, pose = np.random.default_rng(1), np.eye(4)
    pose[:3, 3] = 60.0, 0.0, 1.0
    image = draw_frame(setup, pose, Condition(0.0, 1.0, setup.camera.exposure_s), rng)
    frame = Frame(0, 0.0, image, setup.camera.exposure_s, laser_on=False)
    known = Track(0, 0.0, 0, arc_level=1.0, offset_sigma_y_mm=0.2, offset_sigma_z_mm=0.2)
    told = estimator.of_track(frame, Pose(pose), SeamLine(), known)
    assert abs(told.height_mm) < 3.0 * told.height_sigma_mm < 2.0
    assert told.unknown == ""
    dark = replace(frame, image_dn=np.zeros_like(image))
    for silent, why in (
        (estimator.of_track(frame, Pose(pose), SeamLine(), Track(0, 0.0, 0)), "no_arc"),
        (estimator.of_track(replace(frame, laser_on=True), Pose(pose), SeamLine(), known), "no_stripe"),
        (
            estimator.of_track(frame, Pose(pose), SeamLine(), replace(known, offset_sigma_z_mm=np.nan)),
            "no_surface",
        ),
        (estimator.of_track(dark, Pose(pose), SeamLine(), known), "not_determined"),
    ):
        assert np.isnan(silent.height_mm)
        assert silent.unknown == why
    assert arc_above_surface(estimator, known, None).unknown == "not_tracked"
