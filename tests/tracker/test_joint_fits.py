"""The kernels that put a joint's fit together, against NumPy twins on profiles of all kinds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_twins import fitted_fillet, fitted_groove, fitted_half_v, root_prior
from profiles import Profile, fit_joint, measure
from slot_twins import fitted_slot, share_raised

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint, section
from tracker.joint.groove import PRIOR_SIGMA, mixture_of, outside_hidden_bevel, prior_of
from tracker.profile import MIN_POINTS, in_scan_order
from tracker.state import SCAN

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
CAMERA_MM, LASER_MM = np.array([60.0, 0.0, 130.0]), np.array([0.0, 0.0, 140.0])


def corners_of(joint: Joint) -> Float64:
    """A joint's section (n, 2), its seam point at 0, 0."""
    corners = section(joint).vertices.copy()
    corners[:, 1] += joint.dimensions.get("depth_mm", 0.0)
    return corners


def some_profile(joint: Joint, seed: int) -> Profile:
    """What a sensor may see of a joint: all of it, one side or no root, with spatter, lines out of order."""
    rng = np.random.default_rng(seed)
    hidden_mm = (None, (0.2, rng.uniform(1.0, 6.0)), (-rng.uniform(1.0, 6.0), -0.2), (-0.6, 0.6))[seed % 4]
    seam, sigma_px = (rng.uniform(-2.0, 2.0), -4.0), rng.uniform(0.05, 0.4)
    profile = measure(corners_of(joint), seam, rng, sigma_px=sigma_px, hidden_mm=hidden_mm)
    n = len(profile.y_mm)
    z_mm, scan = profile.z_mm.copy(), profile.scan.copy()
    z_mm[rng.random(n) < 0.03 + 0.3 * (seed % 5 == 4)] += 2.0
    if seed % 3 == 1:
        k = int(rng.integers(n - 1))
        scan[k], scan[k + 1] = scan[k + 1], scan[k]
    seen = replace(profile, z_mm=z_mm, scan=scan, mixed_mm=0.2 * (seed % 2))
    if seed % 3 < 2:
        return seen
    # Of lines half as far apart some are read two by two, and of others every second one.
    n_lines = rng.integers(1, 3, n).astype(float)
    return replace(
        seen,
        scan=2.0 * scan + 0.5 * (n_lines - 1.0),
        column_mm=0.5 * profile.column_mm,
        n_lines=n_lines,
        misfit_px=np.abs(rng.normal(0.0, 0.1, n)),
    )


def a_v(gap_mm: float) -> Joint:
    return Joint("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": gap_mm}, LINE)


A_U = Joint(
    "u_groove", {"depth_mm": 7.0, "root_radius_mm": 2.0, "bevel_angle_deg": 12.0, "root_gap_mm": 1.0}, LINE
)


@pytest.mark.parametrize("joint", [a_v(0.0), a_v(0.3), a_v(1.2), A_U], ids=str)
def test_a_groove_is_its_twin(joint: Joint) -> None:
    determined = 0
    for seed in range(40):
        profile = some_profile(joint, seed)
        found, twin = fit_joint(profile, joint, CAMERA_MM, LASER_MM), fitted_groove(profile, joint)
        assert (found is None) == (twin is None), seed
        if found is None or twin is None:
            continue
        determined += 1
        np.testing.assert_allclose(
            (found.y_mm, found.z_mm), twin.parameters[:2], atol=1e-9, err_msg=str(seed)
        )
        assert found.gap_mm == pytest.approx(max(twin.parameters[2], 0.0), abs=1e-9)
        assert found.chi2 == pytest.approx(twin.chi2, rel=1e-9)
        off_mm2 = found.covariance_mm2 - twin.covariance[:2, :2]
        # What all centres are off alike is added: of rank 1.
        assert off_mm2[0, 0] * off_mm2[1, 1] == pytest.approx(off_mm2[0, 1] ** 2, rel=1e-4)
    assert determined > 20


def a_half_v(gap_mm: float) -> Joint:
    return Joint("half_v", {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": gap_mm}, LINE)


@pytest.mark.parametrize("joint", [a_half_v(0.0), a_half_v(0.3), a_half_v(1.5)], ids=str)
def test_a_half_v_is_its_twin(joint: Joint) -> None:
    determined = 0
    for seed in range(40):
        profile = some_profile(joint, seed)
        found = fit_joint(profile, joint, CAMERA_MM, LASER_MM)
        twin = fitted_half_v(profile, joint, CAMERA_MM, LASER_MM)
        assert (found is None) == (twin is None), seed
        if found is None or twin is None:
            continue
        determined += 1
        gap, root = twin.fit.parameters[:2]
        np.testing.assert_allclose([found.y_mm, found.z_mm], [twin.wall_mm + 0.5 * gap, root], atol=1e-9)
        assert found.gap_mm == pytest.approx(max(gap, 0.0), abs=1e-9)
        assert found.chi2 == pytest.approx(twin.fit.chi2, rel=1e-9)
        assert found.unexplained == pytest.approx(twin.left_out)
    assert determined > 20


@pytest.mark.parametrize("angle_deg", [70.0, 120.0, 270.0])
def test_a_fillet_is_its_twin(angle_deg: float) -> None:
    joint, determined = Joint("fillet", {"included_angle_deg": angle_deg}, LINE), 0
    for seed in range(40):
        profile = some_profile(joint, seed)
        found, twin = fit_joint(profile, joint), fitted_fillet(profile, joint)
        assert (found is None) == (twin is None), seed
        if found is None or twin is None:
            continue
        determined += 1
        fit, left_out = twin
        np.testing.assert_allclose([found.y_mm, found.z_mm], fit.parameters[:2], atol=1e-9)
        assert found.chi2 == pytest.approx(fit.chi2, rel=1e-9)
        assert found.unexplained == pytest.approx(left_out)
    assert determined > 20


def a_slot(joint_type: str, gap_mm: float) -> Joint:
    return Joint(joint_type, {"gap_mm": gap_mm, "thickness_mm": 3.0}, LINE)


@pytest.mark.parametrize("joint", [a_slot("butt", 1.0), a_slot("edge", 0.0), a_slot("edge", 0.6)], ids=str)
def test_a_slot_is_its_twin(joint: Joint) -> None:
    determined = 0
    for seed in range(40):
        profile = some_profile(joint, seed)
        found, twin = fit_joint(profile, joint), fitted_slot(profile, joint)
        assert (found is None) == (twin is None), seed
        if found is None or twin is None:
            continue
        determined += 1
        (z, step, slope_left, slope_right), gap = twin.fit.parameters, twin.gap
        right_mm, left_mm = gap.y_mm + 0.5 * gap.width_mm * np.array([-1.0, 1.0]) - twin.placed_mm
        tops = z + step + slope_right * right_mm, z + slope_left * left_mm
        assert found.y_mm == pytest.approx(gap.y_mm, abs=1e-9)
        assert found.gap_mm == pytest.approx(gap.width_mm, abs=1e-9)
        assert found.z_mm == pytest.approx(0.5 * sum(tops), abs=1e-9)
        assert found.mismatch_mm == pytest.approx(tops[1] - tops[0], abs=1e-9)
        assert found.chi2 == pytest.approx(twin.fit.chi2, rel=1e-9)
        assert found.unexplained == pytest.approx(share_raised(profile, twin))
    assert determined > 20


@pytest.mark.parametrize("stated_mm", [0.0, 0.1, 0.6])
def test_the_prior_of_a_root_is_its_twin(stated_mm: float) -> None:
    np.testing.assert_allclose(prior_of(stated_mm, 0.3), root_prior(stated_mm, 0.3), rtol=1e-12, atol=1e-15)


def test_a_mixture_has_the_mean_and_covariance_of_its_normals() -> None:
    rng = np.random.default_rng(3)
    means, nats = rng.normal(size=(4, 3)), np.array([-3.0, -2.0, -np.inf, -2.5])
    roots = rng.normal(size=(4, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    held = np.array([0, 1, 3])
    mean, covariance = mixture_of(nats[held], means[held], covariances[held])
    shares = np.exp(nats[[0, 1, 3]]) / np.exp(nats).sum()
    kept, within = means[[0, 1, 3]], covariances[[0, 1, 3]]
    np.testing.assert_allclose(mean, shares @ kept, rtol=1e-12)
    second = np.einsum("k,kij->ij", shares, within + kept[:, :, None] * kept[:, None, :])
    np.testing.assert_allclose(covariance, second - np.outer(mean, mean), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_counts_beside_an_unseen_bevel_is_its_twin(side: float) -> None:
    y, start = np.linspace(-9.0, 9.0, 181), np.zeros(9)
    start[2] = 1.4
    out, sure_mm = side * (y - 0.31), start[2] - 2.0 * PRIOR_SIGMA[2]
    counts = outside_hidden_bevel(out, np.array([0.31, -4.0, 1.2]), sure_mm, 3.0)
    np.testing.assert_array_equal(counts, (out + 0.6 < 1.4 - 2.0 * PRIOR_SIGMA[2]) | (out > 4.0))
    assert 0 < counts.sum() < 181


@pytest.mark.parametrize("rises", [True, False])
def test_points_are_put_in_order_as_a_profile_is(rises: bool) -> None:
    profile = some_profile(a_v(1.0), 2)
    rng = np.random.default_rng(1)
    scan = profile.scan if rises else profile.scan[::-1].copy()
    middle = slice(5, -5)
    scan[middle] = rng.permutation(scan[middle])
    shuffled = replace(profile, scan=scan)
    order = np.argsort(scan if rises else -scan, kind="stable")
    ordered, twin = in_scan_order(shuffled.points), shuffled.points[:, order]
    assert (np.diff(ordered[SCAN]) > 0.0).all() if rises else (np.diff(ordered[SCAN]) < 0.0).all()
    np.testing.assert_array_equal(ordered, twin)


@pytest.mark.parametrize(
    "joint", [a_v(1.0), A_U, a_half_v(1.0), Joint("lap", {"thickness_mm": 2.0}, LINE)], ids=str
)
def test_too_few_points_determine_no_joint(joint: Joint) -> None:
    profile, n = some_profile(joint, 0), MIN_POINTS - 1
    names = ("y_mm", "z_mm", "dy_mm", "dz_mm", "sigma_px", "scan", "beside_px")
    short = replace(profile, **{name: getattr(profile, name)[:n].copy() for name in names})
    assert fit_joint(short, joint, CAMERA_MM, LASER_MM) is None
