"""The search, the rules, the path and its cures: small spaces, written-out answers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plan_setups import JOINTS, plan_setup, steel_groove

from noise_model.effects import checked
from noise_model.plan.design import SensorDesign, design_of
from noise_model.plan.noise import BLIND, SeamNoise, Surroundings
from noise_model.plan.path import (
    Path,
    PathNoise,
    blind_stretches,
    leaned,
    noise_along,
    nominal_path,
    recorded_path,
    search_path,
)
from noise_model.plan.plan import PlanOptions, make_plan, search_space
from noise_model.plan.remedies import find_cure, find_cures
from noise_model.plan.rules import RuleOutcome, head_tilted, try_rules
from noise_model.plan.search import EQUAL_SIGMA_SHARE, DesignCandidate, judge, pareto, summarise
from noise_model.surface.joint import Joint, corrugation_height, section
from noise_model.transforms import invert, transform

SILENT = Surroundings(speckle_contrast=0.0)
DESIGN = SensorDesign(24.0, 0.0, 35.0, 145.0, 0.0, 10.0, 0.005)
SMALL = PlanOptions(
    tilt_deg=(20.0, 30.0), azimuth_deg=(0.0, 30.0), preview_mm=(30.0, 40.0), stand_off_mm=(145.0, 145.0)
)


def candidate(sigma_mm: float, preview_mm: float = 35.0, stand_off_mm: float = 145.0) -> DesignCandidate:
    design = replace(DESIGN, preview_mm=preview_mm, stand_off_mm=stand_off_mm)
    return DesignCandidate(design, sigma_mm, sigma_mm, 0.0, 0.1, 1.0, 0.0, 0.0)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([1.0, 1.01, 1.5, 2.0, 3.0, math.inf]),
            st.sampled_from([20.0, 35.0, 50.0]),
            st.sampled_from([100.0, 175.0]),
        ),
        max_size=12,
    )
)
def test_the_front_holds_what_nothing_beats(numbers: list[tuple[float, float, float]]) -> None:
    every = [candidate(*n) for n in numbers]
    front = pareto(every)
    assert [c.sigma_mm for c in front] == sorted(c.sigma_mm for c in front)
    assert len(set(front)) == len(front)
    for c in every:
        known = math.isfinite(c.sigma_mm)
        sigma, preview, stand_off = c.sigma_mm, c.design.preview_mm, c.design.stand_off_mm
        beaten = any(
            o.design.preview_mm <= preview
            and o.design.stand_off_mm >= stand_off
            and (
                o.sigma_mm < sigma
                or (
                    (o.design.preview_mm, o.design.stand_off_mm) != (preview, stand_off)
                    and o.sigma_mm <= (1 + EQUAL_SIGMA_SHARE) * sigma
                )
            )
            for o in every
        )
        assert (c in front) == (known and not beaten)


def test_a_design_is_as_good_as_nearly_its_worst_station() -> None:
    stations = [SeamNoise(0.003, 0.004, 0.1, 0.5, 0.0, 0.0)] * 97 + [BLIND] * 3
    assert summarise(DESIGN, stations).sigma_mm == pytest.approx(0.005)
    assert summarise(DESIGN, stations[:50] + [BLIND] * 3).sigma_mm == math.inf
    assert summarise(DESIGN, stations).blind_share == pytest.approx(0.03)
    assert math.isnan(summarise(DESIGN, [BLIND]).arc_over_stripe)


@given(st.floats(5.0, 60.0), st.floats(-60.0, 60.0), st.floats(5.0, 60.0), st.floats(-10.0, 10.0))
def test_a_tilted_head_keeps_its_triangulation(
    tilt: float, azimuth: float, other: float, lean: float
) -> None:
    own = replace(DESIGN, tilt_deg=tilt, azimuth_deg=azimuth, lean_deg=lean)
    turned = head_tilted(own, other)
    if turned is not None:
        assert turned.tilt_deg == other
        assert turned.triangulation_deg == pytest.approx(own.triangulation_deg, abs=1e-6)
    assert head_tilted(own, tilt) is not None
    assert head_tilted(own, tilt).lean_deg == pytest.approx(lean, abs=1e-6)


def test_the_rules_on_plates_whose_outcome_is_known() -> None:
    poses = search_path(plan_setup("lap", "mild_steel")).T_base_tool
    steel = try_rules(plan_setup("lap", "mild_steel"), poses, SILENT, 0.005)
    # The sheet's light from above is mirrored up: the nearer the camera is to it the brighter the stripe.
    assert steel.tilt.light is RuleOutcome.HOLDS
    assert (steel.tilt.broken_deg, steel.tilt.kept_deg) == (60.0, 10.0)
    # Without triangulation no height: the larger tilt has the smaller sigma in z.
    z = [c.sigma_z_mm for c in steel.tilt.tried]
    assert z[0] > 2.0 * z[-1]
    assert steel.azimuth.tried[3].sigma_z_mm > 10.0 * steel.azimuth.tried[0].sigma_z_mm
    assert steel.own.design == design_of(plan_setup("lap", "mild_steel"))
    # A surface without a lobe has no plane of incidence to stay out of.
    setup = plan_setup("lap", "zn_coated")
    matt = replace(setup, material=replace(setup.material, kappa_spec=0.0))
    assert try_rules(matt, poses, SILENT, 0.005).azimuth.light is RuleOutcome.INDIFFERENT


@pytest.mark.slow
def test_steel_flanks_shine_in_the_plane_of_incidence() -> None:
    setup = plan_setup("corrugation", "mild_steel", radiance_e=3e7)
    rules = try_rules(setup, search_path(setup).T_base_tool, SILENT, 0.005)
    assert rules.azimuth.light is RuleOutcome.HOLDS
    assert rules.azimuth.light_ratio > 1.5


def test_a_pose_below_the_surface_or_upside_down_is_blind() -> None:
    setup = steel_groove()
    sunk, turned = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])
    sunk[2, 3] = -200.0
    turned[2, 3] = 300.0
    for T_base_tool in (sunk, turned):
        [judged] = judge(setup, design_of(setup), T_base_tool[None], SILENT)
        assert judged.sigma_mm == math.inf
        assert judged.blind_share == 1.0


def test_an_exposure_may_only_grow_where_nothing_saturates() -> None:
    setup, poses = steel_groove(), search_path(steel_groove()).T_base_tool
    [own] = judge(setup, design_of(setup), poses, SILENT)
    [long] = judge(setup, design_of(setup), poses, SILENT, None, 0.05)
    assert own.design.exposure_s == 0.005
    assert 0.005 < long.design.exposure_s < 0.05
    assert long.sigma_mm < own.sigma_mm
    [as_long] = judge(setup, long.design, poses, SILENT)
    assert as_long.sigma_mm == pytest.approx(long.sigma_mm, rel=1e-6)
    assert as_long.saturated_share == 0.0
    [too_long] = judge(setup, replace(long.design, exposure_s=0.05), poses, SILENT)
    assert too_long.saturated_share > 0.0


@pytest.mark.parametrize(
    "effects",
    [
        {"hot_metal_glow": {"peak_e": 3e4, "length_mm": 15.0}},
        {"spatter": {"rate_per_frame": 8.0}},
    ],
)
def test_a_design_is_the_same_whatever_exposure_it_is_judged_from(
    effects: dict[str, dict[str, float]],
) -> None:
    """What effects state in e- is for the setup's own exposure, 5 ms."""
    setup, poses = replace(steel_groove(), effects=checked(effects)), search_path(steel_groove()).T_base_tool
    own = design_of(setup)
    [want] = judge(setup, own, poses, SILENT, None, 0.008)
    assert want.arc_over_stripe > 1.05 * judge(steel_groove(), own, poses, SILENT)[0].arc_over_stripe
    for exposure_s in (0.0025, 0.01):
        design = replace(own, exposure_s=exposure_s)
        [got] = judge(setup, design, poses, SILENT, None, 0.008)
        assert got.design == want.design
        assert got.sigma_mm == pytest.approx(want.sigma_mm, rel=1e-9)
        [fixed] = judge(setup, design, poses, SILENT)
        assert fixed.design.exposure_s == exposure_s
        assert fixed.arc_over_stripe == pytest.approx(want.arc_over_stripe, rel=1e-9)


def test_a_filter_that_the_laser_does_not_pass_is_blind_and_the_others_are_judged() -> None:
    setup = steel_groove()
    setup = replace(
        setup,
        laser=replace(setup.laser, wavelength_nm=676.0),
        filter=replace(setup.filter, fwhm_nm=25.0),
    )
    poses = search_path(setup).T_base_tool
    narrow, wide = judge(setup, design_of(setup), poses, SILENT, (5.0, 20.0))
    assert (narrow.design.filter_fwhm_nm, narrow.sigma_mm, narrow.blind_share) == (5.0, math.inf, 1.0)
    assert wide.sigma_mm < 0.1
    with pytest.raises(ValueError, match=r"no filter 3, 5 nm wide passes the laser's 676 nm.*--filter-nm"):
        make_plan(setup, replace(SMALL, filters_nm=(3.0, 5.0)))
    behind_none = replace(setup, filter=replace(setup.filter, fwhm_nm=5.0))
    with pytest.raises(ValueError, match=r"\[filter\]: does not pass the laser's 676 nm"):
        make_plan(behind_none, SMALL)
    with pytest.raises(
        ValueError, match=r"a filter 300 nm wide about 690 nm reaches down to 0 nm.*--filter-nm"
    ):
        make_plan(setup, replace(SMALL, filters_nm=(5.0, 300.0)))


def bent() -> Joint:
    return replace(
        JOINTS["v_groove"], seam_in_base_mm=((10.0, 0.0, 0.0), (110.0, 0.0, 0.0), (110.0, 80.0, 0.0))
    )


def test_a_path_follows_the_seam_round_a_corner() -> None:
    setup = replace(steel_groove(), joint=bent())
    path = nominal_path(setup)
    assert path.length_mm == pytest.approx(180.0)
    np.testing.assert_allclose(path.station_mm[[0, -1]], [0.0, 180.0])
    for station, T in zip(path.station_mm, path.T_base_tool, strict=True):
        x, y, travel = (
            (10.0 + station, 0.0, [1, 0, 0]) if station < 100 else (110.0, station - 100, [0, 1, 0])
        )
        np.testing.assert_allclose(T[:3, 3], [x, y, 0.0], atol=1e-9)
        np.testing.assert_allclose(T[:3, 0], travel, atol=1e-12)
    again = recorded_path(setup, list(path.T_base_tool))
    np.testing.assert_allclose(again.station_mm, path.station_mm, atol=1e-6)


def test_a_path_rides_a_corrugation() -> None:
    setup = plan_setup("corrugation", "mild_steel")
    path = nominal_path(setup)
    assert np.diff(path.station_mm)[0] == pytest.approx(2.5)
    shape = section(setup.joint).corrugation
    np.testing.assert_allclose(path.T_base_tool[:, 2, 3], corrugation_height(path.station_mm, shape))
    assert len(search_path(setup).station_mm) == 8
    assert len(recorded_path(setup, [np.eye(4)] * 1000).station_mm) == 240


def test_a_lean_turns_about_the_torchs_tip() -> None:
    T = np.eye(4)
    T[:3, 3] = 5.0, 1.0, 2.0
    turned = leaned(T, 10.0, 0.0)
    np.testing.assert_allclose(turned[:3, 3], T[:3, 3])
    top = transform(turned, np.array([0.0, 0.0, 100.0])) - T[:3, 3]
    assert top[0] == pytest.approx(100.0 * math.sin(math.radians(10.0)))
    assert transform(leaned(T, 0.0, 10.0), np.array([0.0, 0.0, 100.0]))[1] > 15.0
    np.testing.assert_allclose(leaned(T, 0.0, 0.0), T)
    assert np.linalg.det(invert(turned)) == pytest.approx(1.0)


def test_blind_stretches_are_runs_of_bad_stations() -> None:
    sigma = [0.1, 0.3, math.nan, 0.1, 0.1, 0.2, 0.1, 0.4]
    noise = tuple(SeamNoise(s, 0.0, 0.1, 1.0, 0.0, 0.0) for s in sigma)
    along = PathNoise(Path(np.arange(8.0), np.tile(np.eye(4), (8, 1, 1)), 8.0), noise)
    assert blind_stretches(along, 0.2) == [(1, 2), (7, 7)]
    assert blind_stretches(along, 0.15) == [(1, 2), (5, 5), (7, 7)]
    assert blind_stretches(PathNoise(along.path, noise[:1]), 0.2) == []


def test_glare_on_a_corrugation_is_found_and_cured() -> None:
    setup = plan_setup("corrugation", "mild_steel", radiance_e=3e7)
    whole = nominal_path(setup)
    path = Path(whole.station_mm[:60], whole.T_base_tool[:60], whole.length_mm)
    along = noise_along(setup, path, SILENT)
    aside = replace(design_of(setup), azimuth_deg=150.0)
    heard: list[tuple[int, int]] = []
    cures = find_cures(setup, along, 0.125, SILENT, 10.0, [aside], lambda n, of: heard.append((n, of)))
    stretches = blind_stretches(along, 0.125)
    assert [(cure.first, cure.last) for cure in cures] == stretches
    assert len(stretches) >= 2
    assert heard[-1] == (len(stretches), len(stretches))
    for cure in cures:
        blind = [along.noise[n] for n in range(cure.first, cure.last + 1)]
        assert max(noise.saturated_share for noise in blind) > 0.1
        assert cure.exposed.sigma_mm < 0.125
        assert cure.exposed.design.exposure_s < 0.005
        assert cure.leaned.sigma_mm < 0.125
        assert cure.lean_deg != (0.0, 0.0)
        assert cure.moved.sigma_mm < 0.125
        assert cure.moved.design.exposure_s == 0.005
    # A pitch further on the same stretch has the same cure.
    places = path.station_mm[[cure.first for cure in cures]]
    alike = [
        (a, b)
        for i, a in enumerate(cures)
        for j, b in enumerate(cures)
        if places[j] - places[i] == 60.0 and a.last - a.first == b.last - b.first
    ]
    assert alike
    for a, b in alike:
        assert (a.leaned, a.lean_deg, a.moved) == (b.leaned, b.lean_deg, b.moved)


def test_bends_do_not_share_cures() -> None:
    """The tool stands alike at both places, but from the second the stripe falls on the next leg."""
    points = ((0.0, 0.0, 0.0), (200.0, 0.0, 0.0), (300.0, 70.0, 0.0))
    setup = replace(steel_groove(), joint=replace(JOINTS["v_groove"], seam_in_base_mm=points))
    T_base_tool = np.tile(np.eye(4), (5, 1, 1))
    T_base_tool[:, 0, 3] = 50.0, 100.0, 140.0, 180.0, 190.0
    shown = [SeamNoise(0.001, 0.0, 0.1, 1.0, 0.0, 0.0), BLIND]
    along = PathNoise(Path(T_base_tool[:, 0, 3], T_base_tool, 300.0), tuple(shown[n % 2] for n in range(5)))
    aside = replace(design_of(setup), azimuth_deg=60.0)
    cures = find_cures(setup, along, 0.125, SILENT, 10.0, [aside])
    assert cures == [find_cure(setup, along, (n, n), 0.125, SILENT, 10.0, [aside]) for n in (1, 3)]
    assert cures[0].moved != cures[1].moved


def test_bounced_light_is_left_out_and_said_so() -> None:
    setup = steel_groove()
    bounced = replace(setup, effects=checked({"interreflection": {"albedo": 0.7}}))
    one = replace(SMALL, tilt_deg=(24.0, 24.0), azimuth_deg=(0.0, 0.0), preview_mm=(36.0, 36.0))
    plain, plan = make_plan(setup, one), make_plan(bounced, one)
    assert (plain.left_out, plan.left_out) == ((), ("interreflection",))
    assert plan.own == plain.own
    assert plan.judged == plain.judged
    assert plan.along.noise == plain.along.noise


def test_a_whole_plan() -> None:
    setup = steel_groove()
    stages: list[str] = []
    plan = make_plan(setup, SMALL, None, lambda stage, _done, _of: stages.append(stage))
    assert {"designs", "refinement", "map", "path"} <= set(stages)
    assert len(plan.judged) == 2 * 2 * 2 * 3
    assert plan.own.design == design_of(setup)
    assert plan.limit_mm == 0.125
    assert plan.cures == ()
    best = min(plan.judged, key=lambda c: c.sigma_mm)
    # Within what counts as alike the shorter preview is taken.
    assert plan.front[0].sigma_mm <= (1 + EQUAL_SIGMA_SHARE) * best.sigma_mm
    assert 20.0 <= plan.front[0].design.tilt_deg <= 30.0
    assert plan.noise_map.grid("sigma_mm").shape == (3, 2)
    assert np.isfinite(plan.along.column("sigma_mm")).all()
    # A straight plain seam looks alike all along.
    assert np.ptp(plan.along.column("sigma_mm")) < 1e-6


def test_spaces() -> None:
    assert search_space(steel_groove(), PlanOptions()).azimuths_deg[0] == 0.0
    lap = search_space(plan_setup("lap", "mild_steel"), PlanOptions())
    assert (lap.azimuths_deg[0], lap.azimuths_deg[-1], len(lap.azimuths_deg)) == (-150.0, 180.0, 12)
    assert lap.max_exposure_s == 0.01
    through = [d for d in lap.poses(DESIGN) if d.azimuth_deg == 180.0]
    assert all(d.tilt_deg < 30.0 or d.preview_mm > 40.0 for d in through)
    free = search_space(plan_setup("lap", "mild_steel"), PlanOptions(torch_radius_mm=0.0))
    assert len(free.poses(DESIGN)) == 6 * 12 * 3 * 3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"tilt_deg": (30.0, 20.0)}, "tilt_deg 30 to 20"),
        ({"tilt_deg": (-1.0, 20.0)}, "tilt_deg"),
        ({"preview_mm": (0.0, 20.0)}, "preview_mm"),
        ({"azimuth_deg": (0.0, math.nan)}, "azimuth_deg"),
        ({"filters_nm": ()}, "filters_nm"),
        ({"filters_nm": (5.0, math.inf)}, "filters_nm"),
        ({"filters_nm": (5.0, math.nan)}, "filters_nm"),
        ({"stand_off_mm": (math.nan, 200.0)}, "stand_off_mm nan to 200: must be finite"),
        ({"max_exposure_s": math.nan}, "max_exposure_s"),
        ({"limit_mm": math.inf}, "limit_mm"),
        ({"lean_deg": 50.0}, "lean_deg"),
        ({"torch_radius_mm": -1.0}, "torch_radius_mm"),
        ({"limit_mm": 0.0}, "limit_mm"),
    ],
)
def test_options_that_cannot_be_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PlanOptions(**wrong)


def test_a_flat_plate_has_nothing_to_plan_for() -> None:
    setup = replace(steel_groove(), joint=replace(steel_groove().joint, type="flat"))
    with pytest.raises(ValueError, match="no seam point"):
        make_plan(setup, SMALL)
