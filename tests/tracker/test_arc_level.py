"""The arc's level on simulated frames: right, robust, and honest about what it does not know."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import twins
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import SEED, frame_of, pose_at, small_setup

from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.instrument.sensor import expose
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from tracker.arc.level import (
    ArcLevel,
    _fit_level,
    estimate_ambient_light,
    estimate_arc_level,
    off_stripe,
    only_seen,
    quantile,
    unlit_by_the_laser,
)
from tracker.arc.transmission import NO_LIGHT
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose
from tracker.stripe.expected import expect_stripe
from tracker.stripe.read import arc_map_of

POSE = pose_at(3.0)


@pytest.fixture(scope="module")
def setup() -> Setup:
    return small_setup("v_groove")


@pytest.fixture(scope="module")
def geometry(setup: Setup) -> SensorGeometry:
    return SensorGeometry.of(setup)


def estimate(geometry: SensorGeometry, frame: Frame, pose: Pose = POSE) -> ArcLevel:
    scene = make_scene(geometry.setup, pose.T_base_tool)
    expected = expect_stripe(geometry, scene)
    assert expected is not None
    stripe_px = expected.position_px if frame.laser_on else None
    light = arc_map_of(geometry, arc_kernel(geometry.setup, scene)).at
    look = estimate_arc_level if frame.arc_on else estimate_ambient_light
    unlit = unlit_by_the_laser(geometry, light, None, frame.image_dn, stripe_px, 30.0)
    return look(geometry.image_source, unlit)


@pytest.mark.parametrize("laser", [0.0, 1.0])
@pytest.mark.parametrize("level", [0.3, 1.0, 2.5])
def test_the_level_is_found_within_its_sigma(geometry: SensorGeometry, level: float, laser: float) -> None:
    setup = geometry.setup
    mean = predict(setup, POSE.T_base_tool, Condition(laser, level, 0.005)).mean_e
    found = []
    for draw in range(12):
        image = expose(mean, setup.sensor, np.random.default_rng(SEED + draw))
        found.append(estimate(geometry, Frame(0, 0.0, image, 0.005, laser_on=laser > 0.0)))
    errors = np.array([arc.level - level for arc in found])
    sigmas = np.array([arc.sigma for arc in found])
    print(
        f"level {level}: mean error {errors.mean():.5f}, spread {errors.std():.5f}, sigma {sigmas.mean():.5f}"
    )
    assert (np.abs(errors) < 4.0 * sigmas).all()
    assert (sigmas < 0.03 * level).all()
    assert max(arc.misfit for arc in found) < 1.1


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 2.0), st.floats(0.0, 0.1))
def test_the_fit_is_its_twin(seed: int, level: float, spattered: float) -> None:
    rng = np.random.default_rng(seed)
    map_e = rng.uniform(10.0, 9000.0, 300)
    charge = level * map_e + rng.normal(20.0, 1.0) + rng.normal(0.0, np.sqrt(level * map_e + 2500.0))
    charge[rng.random(300) < spattered] = 2e4
    size = np.empty(300)
    *found, black = _fit_level(map_e, charge, 2500.0, 24.0, 1.0, size)
    *twin, twin_black, twin_size = twins.arc_level(map_e, charge, 2500.0, 24.0, 1.0)
    assert found == pytest.approx(twin, rel=1e-3, abs=1e-5)
    assert black == pytest.approx(twin_black, abs=0.1)
    np.testing.assert_allclose(size, twin_size, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("along_rows", [False, True])
@pytest.mark.parametrize("has_stripe", [False, True])
def test_the_sample_is_its_twin(geometry: SensorGeometry, along_rows: bool, has_stripe: bool) -> None:
    rng = np.random.default_rng(SEED)
    n_scan, n_pos = 30, 50
    image = rng.integers(0, 256, (n_pos, n_scan) if along_rows else (n_scan, n_pos)).astype(np.uint8)
    scan, position = (axis.ravel() for axis in np.meshgrid(np.arange(3, 30, 4), np.arange(2, 50, 5)))
    stripe = rng.uniform(10.0, 40.0, n_scan) if has_stripe else np.empty(0)
    stripe[::7] = np.nan
    code_e = rng.uniform(0.0, 1e4, 256).astype(np.float32)
    source = geometry.image_source._replace(
        n_scan=n_scan,
        n_pos=n_pos,
        along_rows=along_rows,
        charge_e=code_e,
        saturation_dn=200,
        level_scan=scan,
        level_position=position,
    )
    pixels, charge = off_stripe(source, image, stripe, 8.0)
    dn = (image.T if along_rows else image)[scan, position]
    want = dn < 200
    if has_stripe:
        want &= np.abs(position - stripe[scan]) > 8.0
    np.testing.assert_array_equal(pixels, (scan * n_pos + position)[want])
    np.testing.assert_array_equal(charge, code_e[dn[want]])


@pytest.mark.parametrize("has_other", [False, True])
def test_only_what_is_seen_is_kept(has_other: bool) -> None:
    rng = np.random.default_rng(SEED)
    map_e, other = rng.uniform(0.0, 9.0, (2, 200)).astype(np.float32)
    charge = rng.uniform(0.0, 9.0, 200)
    map_e[rng.random(200) < 0.3] = np.nan
    seen = np.isfinite(map_e)
    pixels = rng.permutation(200)
    want = map_e[seen], (charge - other if has_other else charge)[seen], pixels[seen]
    found = only_seen(map_e, charge, other if has_other else NO_LIGHT, pixels)
    np.testing.assert_array_equal((found.arc_e, found.charge_e, found.pixels), want)


def test_spatter_does_not_move_it(geometry: SensorGeometry) -> None:
    frame = frame_of(geometry.setup, POSE)
    clean = estimate(geometry, frame)
    rng = np.random.default_rng(5)
    image = frame.image_dn.copy()
    image[rng.random(image.shape) < 0.05] = 240
    spattered = estimate(geometry, replace(frame, image_dn=image))
    print(f"level {clean.level:.4f} clean, {spattered.level:.4f} under 5 % spatter, sigma {clean.sigma:.4f}")
    assert abs(spattered.level - clean.level) < 0.02
    assert spattered.misfit < 1.5


def test_the_black_level_is_told_from_the_arc(geometry: SensorGeometry) -> None:
    setup = geometry.setup
    shifted = replace(setup, sensor=replace(setup.sensor, black_level_dn=setup.sensor.black_level_dn + 0.5))
    frame = frame_of(shifted, POSE)
    found = estimate(geometry, frame)
    assert found.black_e == pytest.approx(0.5 * setup.sensor.gain_e_per_dn, abs=15.0)
    assert found.level == pytest.approx(1.0, abs=0.02)


def test_dark_frames_hold_no_arc(geometry: SensorGeometry) -> None:
    for draw in range(20):
        frame = frame_of(geometry.setup, POSE, arc=0.0, index=draw)
        found = estimate(geometry, replace(frame, arc_on=True))
        assert found.level < 5.0 * found.sigma
        assert found.misfit < 1.1
        assert abs(found.black_e) < 20.0


def test_where_the_arc_is_said_to_be_off_none_is_sought(geometry: SensorGeometry) -> None:
    """Its pedestal is the offset, its noise no light of the hall."""
    for draw in range(10):
        frame = frame_of(geometry.setup, POSE, arc=0.0, index=draw)
        brighter = replace(frame, image_dn=frame.image_dn + np.uint8(30))
        dark, lit = estimate(geometry, frame), estimate(geometry, brighter)
        assert not lit.is_on
        assert lit.level == 0.0
        assert np.isnan(lit.misfit)
        assert lit.black_e - dark.black_e == pytest.approx(30.0 * geometry.setup.sensor.gain_e_per_dn)
        assert dark.ambient_e == lit.ambient_e == 0.0


@pytest.mark.parametrize("uneven", [0.0, 0.4])
def test_light_of_the_hall_is_no_arc(geometry: SensorGeometry, uneven: float) -> None:
    """75 grey levels of it, as much as the arc's own light; a plate that is brighter on one side as well."""
    frame = frame_of(geometry.setup, POSE, arc=0.5)
    u = np.arange(frame.image_dn.shape[1])
    ambient_dn = 75.0 * (1.0 + uneven * np.sign(u - 0.6 * u.max()))
    image = np.minimum(frame.image_dn + ambient_dn, 255.0).astype(np.uint8)
    found = estimate(geometry, replace(frame, image_dn=image))
    print(f"level {found.level:.3f} ± {found.sigma:.3f}, offset {found.black_e:.0f} e-, {found.misfit:.2f}")
    assert found.level == pytest.approx(0.5, abs=0.02 if uneven == 0.0 else 0.1)
    assert (found.misfit < 1.0) == (uneven == 0.0)


def test_light_of_the_hall_is_known_as_well_as_it_is_even(geometry: SensorGeometry) -> None:
    """A checkered plate whose light is 1500 e- off its mean, to either side."""
    frame = frame_of(geometry.setup, POSE, arc=0.0)
    v, u = np.indices(frame.image_dn.shape)
    texture_dn = round(1500.0 / geometry.setup.sensor.gain_e_per_dn)
    image = frame.image_dn + 2 * texture_dn * ((u // 8 + v // 8) % 2)
    found = estimate(geometry, replace(frame, image_dn=image.astype(np.uint8)))
    # The median lies on either of two levels, as far from the other as they are apart.
    apart_e = 2.0 * texture_dn * geometry.setup.sensor.gain_e_per_dn
    assert found.ambient_e == pytest.approx(apart_e / 1.645, rel=0.15)


def test_a_ridge_before_the_arc_leaves_its_level_unknown() -> None:
    """Bare steel behind a ridge: hardly any of the arc's light is in view, and any level would do."""
    setup = small_setup("corrugation")
    arc = replace(setup.arc, radiance_e=3e7)
    geometry = SensorGeometry.of(replace(setup, material=TABLE_1["mild_steel"], arc=arc))
    found = [
        estimate(geometry, frame_of(geometry.setup, pose_at(x), index=n), pose_at(x))
        for n, x in enumerate((0.0, 44.0, 46.0, 48.0))
    ]
    print([f"{arc.level:.3g} ± {arc.sigma:.2g}" for arc in found])
    assert found[0].level == pytest.approx(1.0, abs=0.03)
    assert all(math.isnan(arc.level) or abs(arc.level - 1.0) < 5.0 * arc.sigma < 1.0 for arc in found[1:])
    assert any(math.isnan(arc.level) for arc in found[1:])


@pytest.mark.parametrize("code", [0, 255])
def test_black_and_white_frames_give_no_nonsense(geometry: SensorGeometry, code: int) -> None:
    image = np.full((geometry.setup.camera.height, geometry.setup.camera.width), code, dtype=np.uint8)
    found = estimate(geometry, Frame(0, 0.0, image, 0.005, laser_on=False))
    if code == 255:
        assert np.isnan((found.level, found.sigma, found.misfit)).all()
        assert np.isnan(found.level)
        assert np.isnan(found.misfit)
    else:
        assert found.level == 0.0


def test_another_material_does_not_fit() -> None:
    """A coating whose lobe is brighter, on a corrugation's flanks that mirror the arc into the lens."""
    geometry = SensorGeometry.of(small_setup("corrugation"))
    setup = geometry.setup
    glossy = replace(setup, material=replace(setup.material, kappa_spec=3.0, c2=12.0))
    found = estimate(geometry, frame_of(setup, POSE, laser=0.0, of=glossy))
    assert found.misfit > 5.0
    assert estimate(geometry, frame_of(setup, POSE, laser=0.0)).misfit < 1.0


def test_an_arc_of_another_height_does_not_fit() -> None:
    """The upper sheet's shadow on the lower one lies elsewhere."""
    geometry = SensorGeometry.of(small_setup("lap"))
    setup = geometry.setup
    x, y, z = setup.arc.center_in_tool_mm
    for higher_mm in (-1.0, 2.0):
        moved = replace(setup, arc=replace(setup.arc, center_in_tool_mm=(x, y, z + higher_mm)))
        found = estimate(geometry, frame_of(setup, POSE, laser=0.0, arc=2.0, of=moved))
        assert found.misfit > 2.0
    assert estimate(geometry, frame_of(setup, POSE, laser=0.0, arc=2.0)).misfit < 1.0


def test_the_stripe_is_left_out(geometry: SensorGeometry) -> None:
    bright = frame_of(geometry.setup, POSE, laser=3.0, arc=0.5)
    assert estimate(geometry, bright).level == pytest.approx(0.5, abs=0.01)


@given(
    st.lists(st.floats(-1e6, 1e6) | st.integers(-3, 3).map(float), min_size=1, max_size=40),
    st.floats(0.0, 1.0),
)
def test_a_quantile_is_the_value_of_its_rank(values: list[float], share: float) -> None:
    rank = int(np.ceil(share * (len(values) - 1)))
    assert quantile(np.array(values), share) == sorted(values)[rank]
