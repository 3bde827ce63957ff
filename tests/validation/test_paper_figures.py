import re
from pathlib import Path

import numpy as np
import pytest

from noise_model.instrument.spectrum import (
    ArcSpectrum,
    Filter,
    angle_shift,
    laser_transmission,
    line_to_continuum,
    passed_continuum,
)
from noise_model.surface.brdf import MILD_STEEL, ZN_COATED, reflectance
from validation.figures.hemisphere import (
    irradiance_extended,
    point_source_distance,
    reflected_radiance_extended,
)
from validation.figures.mirror import SUS304, mirror_direction
from validation.figures.paper_curves import (
    ARC,
    DISTANCE_MM,
    FARTHEST_MM,
    FIGURES,
    MIDDLE_MM,
    NEAREST_MM,
    RADIUS_MM,
    UP,
    agrees_from_mm,
    lobe_over_diffuse,
    off_specular_peaks,
    patches,
    point_error,
)

DOCS = Path(__file__).resolve().parents[2] / "docs" / "explanation"
PAGE = (DOCS / "paper.md").read_text()

ANGLES = np.random.default_rng(1).uniform([2.0, 0.0, -170.0], [85.0, 85.0, 170.0], (200, 3))


def f_r(at, material):
    return reflectance(
        at.omega_i, at.omega_r, at.normals, material.kappa_diff, material.kappa_spec, material.c2
    )


def at_azimuth(figure, phi_r_deg, curve="extended"):
    return float(np.interp(phi_r_deg, figure.phi_r_deg, getattr(figure, curve)))


def peaks_of(material, theta_i_deg):
    return off_specular_peaks(material, theta_i_deg)


@pytest.mark.parametrize("towards_up", [True, False])
@pytest.mark.parametrize("aim_mm", [ARC.center_mm, MIDDLE_MM], ids=["centre", "middle"])
def test_a_patch_has_the_angles_asked_for(towards_up, aim_mm):
    theta_i, theta_r, phi_r = np.radians(ANGLES).T
    at = patches(30.0, *ANGLES.T, towards_up=towards_up, aim_mm=aim_mm)
    for directions in (at.normals, at.omega_i, at.omega_r):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(at.points_mm, axis=1), 30.0)
    np.testing.assert_allclose(at.points_mm @ UP, 0.0)
    np.testing.assert_allclose(np.sum(at.omega_i * at.normals, axis=1), np.cos(theta_i))
    np.testing.assert_allclose(np.sum(at.omega_r * at.normals, axis=1), np.cos(theta_r))
    tangents = [
        omega - np.sum(omega * at.normals, axis=1)[:, np.newaxis] * at.normals
        for omega in (at.omega_i, at.omega_r)
    ]
    between = np.sum(tangents[0] * tangents[1], axis=1)
    np.testing.assert_allclose(between, -np.sin(theta_i) * np.sin(theta_r) * np.cos(phi_r), atol=1e-12)
    upward = (at.normals - np.cos(theta_i)[:, np.newaxis] * at.omega_i) @ UP
    assert ((upward > 0) == towards_up).all()


def test_at_the_mirror_angle_the_aim_is_mirrored():
    at = patches(10.0, [0.0, 30.0, 70.0], [0.0, 30.0, 70.0], aim_mm=MIDDLE_MM)
    np.testing.assert_allclose(mirror_direction(at.omega_i, at.normals), at.omega_r, atol=1e-12)


@pytest.mark.parametrize("number", [6, 7, 8])
def test_extended_and_point_agree_far_away_and_part_near(number):
    figure = FIGURES[number]()
    error = np.abs(point_error(figure))
    assert figure.a_mm[[0, -1]] == pytest.approx([NEAREST_MM, FARTHEST_MM])
    assert figure.extended[0] == 1.0
    assert error[0] > 0.1
    assert error[figure.a_mm > 15.0 * RADIUS_MM].max() < 2e-3
    assert (np.diff(error[figure.a_mm < 2.5 * RADIUS_MM]) < 0).all()


@pytest.mark.parametrize("number", [6, 7, 8])
def test_the_distance_of_agreement_is_where_the_error_crosses(number):
    figure = FIGURES[number]()
    for tolerance in (0.1, 0.01):
        a_mm = agrees_from_mm(figure, tolerance)
        assert np.interp(a_mm, figure.a_mm, np.abs(point_error(figure))) == pytest.approx(tolerance, rel=0.02)


def test_far_away_steel_and_zn_fall_with_the_square_of_the_distance():
    for number in (6, 7):
        figure = FIGURES[number]()
        slope = np.diff(np.log(figure.extended)) / np.diff(np.log(figure.a_mm))
        # The arc's middle, above C, approaches theta_i = 70 deg as 1/a: steel's slope is the last to settle.
        assert slope[-1] == pytest.approx(-2.0, abs=0.04)


def test_near_by_the_arc_reaches_steels_lobe_from_far_off_the_mirror_angle():
    figure = FIGURES[6]()
    assert figure.extended[0] / figure.extended[-1] > 4.0 * (FARTHEST_MM / NEAREST_MM) ** 2
    zn = FIGURES[7]()
    assert zn.extended[0] / zn.extended[-1] == pytest.approx((FARTHEST_MM / NEAREST_MM) ** 2, rel=0.02)


def test_a_mirror_keeps_the_arcs_radiance_at_any_distance():
    figure = FIGURES[8]()
    np.testing.assert_array_equal(figure.image, 1.0)
    assert figure.extended[-1] < 2e-3
    beside = patches(30.0, 50.0, 50.0 + 5.0, aim_mm=MIDDLE_MM)
    assert reflected_radiance_extended(beside.points_mm, beside.normals, beside.omega_r, ARC, SUS304) == 0.0


def test_the_mirrors_curves_are_irradiances():
    figure = FIGURES[8]()
    at = patches(figure.a_mm[[0, 60]], 50.0, 50.0, aim_mm=MIDDLE_MM)
    E = irradiance_extended(at.points_mm, at.normals, ARC, nodes=48)
    assert figure.extended[60] == pytest.approx(E[1] / E[0], rel=1e-4)


@pytest.mark.parametrize("number", [9, 10])
def test_noise_falls_out_of_the_plane_of_incidence(number):
    figure = FIGURES[number]()
    for curve in (figure.extended, figure.point):
        assert curve.max() == curve[90] == 1.0
        np.testing.assert_allclose(curve, curve[::-1], rtol=1e-6)
        assert (np.diff(curve[90:]) < 1e-6).all()


def test_steel_is_lobe_and_zn_is_diffuse():
    assert lobe_over_diffuse(MILD_STEEL, 60.0) == pytest.approx(0.326 / 0.021 / np.cos(np.pi / 3.0))
    assert lobe_over_diffuse(MILD_STEEL, 30.0) > 10.0
    assert lobe_over_diffuse(ZN_COATED, 60.0) < 1.0
    assert at_azimuth(FIGURES[9](), 90.0) < 0.1
    assert at_azimuth(FIGURES[10](), 90.0) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("number", [11, 12])
def test_the_viewing_curves_are_over_their_own_peaks(number):
    figure = FIGURES[number]()
    assert [of.material for of in figure.of_materials] == [MILD_STEEL, ZN_COATED]
    assert len(figure.columns()) == 7
    for of in figure.of_materials:
        peaks = peaks_of(of.material, figure.theta_i_deg)
        for curve, peak_deg in (
            (of.f_r, peaks.f_r_deg),
            (of.lobe_flat, peaks.lobe_flat_deg),
            (of.extended, peaks.extended_deg),
        ):
            assert curve.max() == 1.0
            assert figure.theta_r_deg[curve.argmax()] == pytest.approx(peak_deg, abs=0.13)


@pytest.mark.parametrize(
    ("material", "theta_i_deg", "peak_deg"), [(MILD_STEEL, 60.0, 61.92), (ZN_COATED, 30.0, 42.69)]
)
def test_the_peak_lies_beyond_the_mirror_angle_for_the_lobes_cosine_not_for_G(
    material, theta_i_deg, peak_deg
):
    peaks = peaks_of(material, theta_i_deg)
    assert peaks.f_r_deg == pytest.approx(peak_deg, abs=0.01)
    assert peaks.attenuation == 1.0
    assert peaks.lobe_flat_deg == pytest.approx(theta_i_deg, abs=0.01)
    moved = np.radians(peaks.f_r_deg - theta_i_deg)
    assert 0.5 * material.c2 * moved == pytest.approx(np.tan(np.radians(peaks.f_r_deg)), rel=1e-3)


def test_G_ends_the_rise_of_zn_under_60_degrees():
    peaks = peaks_of(ZN_COATED, 60.0)
    assert peaks.f_r_deg == pytest.approx(80.0, abs=0.01)
    before, beyond = (f_r(patches(30.0, 60.0, 80.0 + step), ZN_COATED)[0] for step in (-0.5, 0.5))
    top = f_r(patches(30.0, 60.0, 80.0), ZN_COATED)[0]
    # A kink: the slope turns round at once.
    assert top - before > 0.004
    assert top - beyond > 0.001


@pytest.mark.slow
def test_under_the_arc_the_peaks_move_with_the_luminous_half():
    for material, theta_i_deg in ((MILD_STEEL, 60.0), (MILD_STEEL, 30.0), (ZN_COATED, 30.0)):
        peaks = peaks_of(material, theta_i_deg)
        assert peaks.extended_deg < peaks.f_r_deg < peaks.extended_away_deg


def test_more_nodes_change_nothing():
    at = patches(DISTANCE_MM, 60.0, np.linspace(0.0, 85.0, 18))
    for material in (MILD_STEEL, ZN_COATED):
        coarse, fine = (
            reflected_radiance_extended(at.points_mm, at.normals, at.omega_r, ARC, material, nodes=nodes)
            for nodes in (16, 40)
        )
        np.testing.assert_allclose(coarse, fine, rtol=1e-3)


# What docs/explanation/paper.md quotes.


def number(value, digits=2):
    return f"{value:.{digits}f}".replace("-", "−")


def page_has(*cells):
    """Whether a table row of these cells stands on the page."""
    row = "| " + " | ".join(cells) + " |"
    assert row in PAGE, row


def test_the_page_quotes_figures_6_to_8():
    for n, name in ((6, "steel"), (7, "Zn"), (8, "light on the mirror")):
        figure = FIGURES[n]()
        error = number(100.0 * point_error(figure)[0], 0) + " %"
        distances = [f"{agrees_from_mm(figure, tolerance):.1f} mm" for tolerance in (0.1, 0.05, 0.01)]
        page_has(f"{n}, {name}", error, *distances)


def test_the_page_quotes_figures_9_and_10():
    for n, name in ((9, "steel"), (10, "Zn")):
        figure = FIGURES[n]()
        values = [
            f"{at_azimuth(figure, phi):.2f} ({at_azimuth(figure, phi, 'point'):.2f})"
            for phi in (10.0, 20.0, 30.0, 60.0, 90.0)
        ]
        page_has(f"{n}, {name}", *values)
    page_has("steel", *(f"{lobe_over_diffuse(MILD_STEEL, theta):.1f}" for theta in (30.0, 60.0)))
    page_has("Zn", *(f"{lobe_over_diffuse(ZN_COATED, theta):.2f}" for theta in (30.0, 60.0)))


@pytest.mark.slow
def test_the_page_quotes_figures_11_and_12():
    for n, theta_i_deg in ((11, 60.0), (12, 30.0)):
        for name, material in (("steel", MILD_STEEL), ("Zn", ZN_COATED)):
            of = peaks_of(material, theta_i_deg)
            angles = (of.f_r_deg, of.lobe_flat_deg, of.extended_deg, of.extended_away_deg)
            page_has(
                f"{n}, {name}, {theta_i_deg:.0f}°",
                *(f"{angle:.1f}°" for angle in angles),
                f"{of.attenuation:.3f}",
            )


@pytest.mark.slow
def test_the_page_quotes_the_distances_of_the_point_source():
    view = np.array([np.sin(np.radians(20.0)), 0.0, np.cos(np.radians(20.0))])
    rows = [
        ("steel, flat plate, viewed at 20°", MILD_STEEL, None),
        ("Zn-coated, flat plate, viewed at 20°", ZN_COATED, None),
        ("steel, θ_i = 70°, θ_r = 20°", MILD_STEEL, (70.0, 20.0)),
        ("Zn-coated, θ_i = 30°, θ_r = 60°", ZN_COATED, (30.0, 60.0)),
        ("steel, θ_i = θ_r = 60°, in the lobe", MILD_STEEL, (60.0, 60.0)),
    ]
    for name, material, angles in rows:
        at = patches(1.0, *(angles or (0.0, 0.0)))
        normal, omega_r = (UP, view) if angles is None else (at.normals[0], at.omega_r[0])
        distances = [
            point_source_distance(at.points_mm[0], normal, omega_r, ARC, material, tolerance, nodes=16)
            for tolerance in (0.1, 0.05, 0.01)
        ]
        page_has(name, *(f"{a_mm / RADIUS_MM:.1f}" for a_mm in distances))


def test_the_page_quotes_the_filter_over_the_field():
    optics, spectrum = Filter(690.0, 10.0, 1.8), ArcSpectrum()
    for theta_deg in (0.0, 5.0, 10.0, 15.0):
        theta = np.radians(theta_deg)
        page_has(
            f"{theta_deg:.0f}°",
            f"{690.0 * angle_shift(theta, 1.8):.1f} nm",
            f"{laser_transmission(optics, 690.0, theta):.3f}",
            f"{passed_continuum(optics, spectrum, theta) / passed_continuum(optics, spectrum):.3f}",
            f"{line_to_continuum(optics, spectrum, theta) / line_to_continuum(optics, spectrum):.2f}",
        )


def test_every_picture_on_the_page_is_there_and_small():
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", PAGE)
    assert len(pictures) == len(FIGURES)
    for picture in pictures:
        assert (DOCS / picture).stat().st_size < 80_000


@pytest.mark.parametrize("number", FIGURES)
def test_the_stored_curves_are_those_that_the_functions_give(number):
    columns = FIGURES[number]().columns()
    path = DOCS / "figures" / f"figure_{number:02d}.csv"
    stored = np.genfromtxt(path, delimiter=",", names=True)
    assert stored.dtype.names == tuple(columns)
    for name, values in columns.items():
        np.testing.assert_allclose(stored[name], values, rtol=1e-5, atol=1e-6)
