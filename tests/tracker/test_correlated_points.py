"""A joint's covariance of correlated neighbouring points, against drawn traces."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from profiles import PX_MM, Profile, fit_joint, groove, lap, measure
from rendered import SEED

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint
from tracker.joint import MeasuredJoint

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
CAMERA_MM, LASER_MM = np.array([-55.0, 0.0, 135.0]), np.array([0.0, 0.0, 140.0])
JOINTS = {
    "v_groove": (
        Joint("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, LINE),
        groove((30.0, 30.0), (4.0, 4.0), 1.0),
    ),
    "lap": (Joint("lap", {"thickness_mm": 2.0}, LINE), lap(2.0)),
}
OWN_PX = 0.15
"""The noise of each point by itself."""


def correlation(apart: Float64, grain_px: float) -> Float64:
    """The correlation of points that far apart: white noise behind a Gaussian of 1 sigma `grain_px`."""
    return np.asarray(np.exp(-(apart**2) / (4.0 * grain_px**2)))


def points_as_one(grain_px: float) -> float:
    """How many points in a row are off as one: the sum of their correlation."""
    return float(correlation(np.arange(-40.0, 41.0), grain_px).sum())


def traces(of: str, grain_px: float, shared_px: float, n: int):
    """Draw profiles whose points have noise of their own and some that they share with their neighbours.

    What is shared is a Gaussian sequence of a grain's correlation, by the square root of its matrix, and
    twice as strong on the seam's one side as on its other.
    """
    rng = np.random.default_rng(SEED)
    exact = measure(JOINTS[of][1], (0.0, 0.0), rng, noise=False)
    here = np.arange(len(exact.y_mm), dtype=float)
    values, vectors = np.linalg.eigh(correlation(here[:, None] - here, grain_px))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    shared = np.where(exact.y_mm > 0.0, 2.0, 1.0) * shared_px
    sigma = np.hypot(OWN_PX, shared)
    effective = np.sqrt(OWN_PX**2 + points_as_one(grain_px) * shared**2)
    for _ in range(n):
        off = OWN_PX * rng.normal(size=len(here)) + shared * (root @ rng.normal(size=len(here)))
        y, z = exact.y_mm + PX_MM[0] * off, exact.z_mm + PX_MM[1] * off
        order = np.argsort(y, kind="stable")
        yield replace(exact, y_mm=y[order], z_mm=z[order], sigma_px=sigma[order], beside_px=effective[order])


def fit(of: str, profile: Profile) -> MeasuredJoint:
    found = fit_joint(profile, JOINTS[of][0], CAMERA_MM, LASER_MM)
    assert found is not None
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("of", "axes"), [("v_groove", (0, 1)), ("lap", (1,))])
@pytest.mark.parametrize("grain_px", [0.5, 1.0, 2.5])
def test_the_covariance_of_correlated_points_is_honest(
    of: str, axes: tuple[int, ...], grain_px: float
) -> None:
    """A lap's lateral place is its columns' spacing, whatever their noise."""
    scaled, alone = [], []
    for profile in traces(of, grain_px, 0.3, 300):
        for kept, square in ((profile, scaled), (replace(profile, beside_px=profile.sigma_px), alone)):
            found = fit(of, kept)
            error = np.array([found.y_mm, found.z_mm])
            square.append(error**2 / np.diag(found.covariance_mm2))
    honest, before = (np.mean(square, axis=0)[list(axes)] for square in (scaled, alone))
    print(f"{of}, {points_as_one(grain_px):.1f} as one: chi2 {honest}, if taken for independent {before}")
    assert (np.abs(honest - 1.0) < 4.0 * math.sqrt(2.0 / 300.0)).all()
    if points_as_one(grain_px) > 2.0:
        assert (before > 1.5).all()


@pytest.mark.slow
def test_independent_points_keep_their_covariance() -> None:
    for profile in traces("v_groove", 1.0, 0.0, 3):
        found = fit("v_groove", profile)
        alone = fit("v_groove", replace(profile, beside_px=profile.sigma_px))
        np.testing.assert_array_equal(found.covariance_mm2, alone.covariance_mm2)
