import dataclasses
import math

import cv2
import numpy as np
import pytest
import scenes
from sheet_twin import reflected_sheet_plain

from noise_model import forward
from noise_model.arc.map import arc_at, arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.effects import REGISTRY, checked
from noise_model.forward import FILL_TOLERANCE, Renderer, draw_frame, predict
from noise_model.instrument.camera import Camera, Rays
from noise_model.stripe import check_stripe, reflected_sheet, stripe_reference
from noise_model.surface.brdf import Lobe
from noise_model.surface.joint import NOMINAL_SEAM, BentSeam, SeamLine
from noise_model.transforms import invert, moved
from noise_model.view import View

LEVEL = scenes.pose()
TURNED = scenes.pose((4.0, 0.5, 1.0), (3.0, -2.0, 4.0))
EXPOSURE_S = 0.005


def stripe_alone(setup, T_base_tool=LEVEL, seam=NOMINAL_SEAM, **changes):
    condition = Condition(**({"laser_level": 1.0, "arc_level": 0.0, "exposure_s": EXPOSURE_S} | changes))
    return predict(setup, T_base_tool, condition, seam=seam).mean_e.astype(np.float64)


def sharp(**changes):
    return scenes.camera(psf_sigma_px=0.0, **changes)


@pytest.mark.parametrize("side", [2, 4, 7])
def test_a_coarse_camera_s_stripe_peaks_as_high_as_a_fine_one_s(side):
    """The peak is the light's, whether or not a pixel's middle lies on it."""
    fine = scenes.setup("flat", of_camera=scenes.camera(width=560, height=560, focal_px=1900.0))
    coarse = dataclasses.replace(fine, camera=fine.camera.coarser(side))
    assert stripe_reference(coarse) == pytest.approx(stripe_reference(fine), rel=1e-3)


def test_a_fan_ends_in_the_image_where_it_ends_on_the_plate():
    """At y = h tan(psi): there the blurred stripe has half its light, and beside nothing has changed."""
    setup = scenes.setup("flat")
    half_mm = 140.0 * math.tan(math.radians(5.0))
    narrow = dataclasses.replace(setup, laser=dataclasses.replace(setup.laser, fan_half_angle_deg=5.0))
    wide_e, narrow_e = stripe_alone(setup), stripe_alone(narrow)
    ends = np.sort(project(setup.camera, np.array([[35.0, -half_mm, 0.0], [35.0, half_mm, 0.0]]))[:, 0])
    u = np.arange(wide_e.shape[1])
    inside = (u > ends[0] + 5.0) & (u < ends[1] - 5.0)
    outside = (u < ends[0] - 5.0) | (u > ends[1] + 5.0)
    np.testing.assert_array_equal(narrow_e[:, inside], wide_e[:, inside])
    assert not narrow_e[:, outside].any()
    share = narrow_e.sum(axis=0) / wide_e.sum(axis=0)
    for end, side in zip(ends, (1.0, -1.0), strict=True):
        near = np.abs(u - end) < 5.0
        assert np.interp(0.5, share[near][:: int(side)], u[near][:: int(side)]) == pytest.approx(
            end, abs=0.05
        )


def peak_rows(image, columns):
    """The stripe's centre in each column by a parabola through the logarithms of its three highest rows."""
    rows = np.argmax(image[:, columns], axis=0)
    low, mid, high = (np.log(image[rows + i, columns]) for i in (-1, 0, 1))
    return rows + 0.5 * (low - high) / (low - 2.0 * mid + high)


def peak_height(column):
    """The height of a Gaussian between pixels: that parabola's."""
    row = int(np.argmax(column))
    low, mid, high = np.log(column[row - 1 : row + 2])
    return math.exp(mid - (low - high) ** 2 / (8.0 * (low - 2.0 * mid + high)))


def project(camera: Camera, points_tool):
    """Pinhole and OpenCV's distortion by OpenCV itself; (u, v) of points (N, 3) of the tool frame."""
    T = np.linalg.inv(camera.T_tool_camera)
    rotation, _ = cv2.Rodrigues(T[:3, :3])
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    uv, _ = cv2.projectPoints(points_tool, rotation, T[:3, 3], matrix, np.array(camera.distortion))
    return uv[:, 0]


@pytest.mark.parametrize("material", ["mild_steel", "zn_coated"])
def test_the_stripes_peak_is_peak_e(material):
    setup = scenes.setup("flat", material, of_camera=sharp(width=161, height=121))
    assert peak_height(stripe_alone(setup)[:, 80]) == pytest.approx(5000.0, rel=5e-4)


def test_an_even_width_has_its_middle_between_two_columns():
    setup = scenes.setup("flat", of_camera=sharp())
    image = stripe_alone(setup)
    assert 0.5 * (image[:, 79].max() + image[:, 80].max()) == pytest.approx(5000.0, rel=1e-4)


def test_a_camera_on_its_side_sees_the_same_stripe():
    """The stripe runs along columns then: its peak counts in the middle row."""
    upright = scenes.camera(psf_sigma_px=0.0, width=161, height=121)
    T_tool_camera = upright.T_tool_camera.copy()
    T_tool_camera[:3, :3] = upright.T_tool_camera[:3, :3] @ np.array(
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    )
    on_side = dataclasses.replace(
        upright, width=121, height=161, cx=upright.cy, cy=upright.cx, T_tool_camera=T_tool_camera
    )
    seen = stripe_alone(scenes.setup("v_groove", of_camera=on_side))
    want = stripe_alone(scenes.setup("v_groove", of_camera=upright))
    np.testing.assert_allclose(np.rot90(seen), want, rtol=1e-3, atol=1e-3)


def test_a_stripe_that_the_middle_column_never_sees_is_refused():
    setup = scenes.setup("flat", of_camera=scenes.camera(((95.0, 0.0, 130.0), (90.0, 0.0, 0.0))))
    with pytest.raises(ValueError, match=r"^\[laser\] plane_in_tool"):
        check_stripe(setup)
    check_stripe(scenes.setup("flat"))


def test_a_stripe_at_a_grazing_camera_s_back_has_no_reference():
    setup = scenes.setup("flat", of_camera=scenes.camera(((95.0, 0.0, -5.0), (36.0, 0.0, -20.0))))
    with pytest.raises(ValueError, match=r"^\[laser\] plane_in_tool"):
        stripe_reference(setup)


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (1, 2), (3, 1), (2, 2)])
@pytest.mark.parametrize("joint", ["flat", "v_groove", "lap"])
def test_an_image_of_a_few_pixels_is_predicted_as_they_are_one_by_one(joint, size):
    width, height = size
    camera = scenes.camera(width=width, height=height, focal_px=200.0, psf_sigma_px=0.0)
    setup, condition = scenes.setup(joint, of_camera=camera), Condition(0.0, 1.0, EXPOSURE_S)
    whole = predict(setup, LEVEL, condition).mean_e
    alone = predict(setup, LEVEL, condition, pixels=np.arange(width * height)).mean_e
    assert whole.ravel() == pytest.approx(alone, rel=1e-3)
    assert whole.min() > 1.0


@pytest.mark.parametrize("material", ["mild_steel", "zn_coated"])
@pytest.mark.parametrize("turn_deg", [-20.0, -8.0, 0.0, 6.0, 12.0])
def test_the_stripes_reference_is_the_light_of_one_place_wherever_the_camera_looks(material, turn_deg):
    """The sheet's plane and the middle column meet under the laser here; the image may lie elsewhere."""
    setup = scenes.setup("flat", material, of_camera=scenes.camera(width=161, height=121))
    upright = setup.camera.T_tool_camera
    T_tool_camera = moved(upright, [turn_deg, 0.0, 0.0], [0.0, 0.0, 0.0])
    turned = dataclasses.replace(setup, camera=dataclasses.replace(setup.camera, T_tool_camera=T_tool_camera))
    P = np.array([-setup.laser.plane_in_tool[3], 0.0, 0.0])
    to_camera = T_tool_camera[:3, 3] - P
    to_laser = np.array(setup.laser.origin_in_tool_mm) - P
    to_camera, to_laser = (way / np.linalg.norm(way) for way in (to_camera, to_laser))
    f_r = scenes.f_r(to_laser[np.newaxis], to_camera, np.array([0.0, 0.0, 1.0]), setup.material)[0]
    # The sheet is 1 on its axis at tool height.
    cos_field = -to_camera @ T_tool_camera[:3, 2]
    assert stripe_reference(turned) == pytest.approx(f_r * cos_field**4, rel=1e-9)


@pytest.mark.parametrize("z_mm", [-3.0, 0.0, 6.0])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.2, 0.1, 0.002, -0.001, 0.0)])
def test_the_stripe_lies_where_plane_and_plate_meet(z_mm, distortion):
    camera = dataclasses.replace(sharp(), distortion=distortion)
    setup = scenes.setup("flat", of_camera=camera)
    image = stripe_alone(setup, scenes.pose((0.0, 0.0, -z_mm)))
    y = np.linspace(-30.0, 30.0, 2001)
    u, v = project(camera, np.column_stack([np.full(2001, 35.0), y, np.full(2001, z_mm)])).T
    columns = np.arange(10, 150)
    order = np.argsort(u)
    # What pulls the peak off the sheet's middle is how brightness changes across it: 1e-2 px here.
    np.testing.assert_allclose(peak_rows(image, columns), np.interp(columns, u[order], v[order]), atol=0.02)


def test_the_stripe_follows_a_v_groove():
    setup = scenes.setup("v_groove", of_camera=sharp())
    image = stripe_alone(setup)
    y = np.linspace(-20.0, 20.0, 4001)
    z = scenes.height(setup.joint, np.zeros(4001), y)
    u, v = project(setup.camera, np.column_stack([np.full(4001, 35.0), y, z])).T
    # Columns all of whose stripe lies on one face.
    for low, high in ((-18.0, -4.2), (-2.8, -0.9), (0.9, 2.8), (4.2, 18.0)):
        inside = (y > low) & (y < high)
        columns = np.arange(math.ceil(u[inside].min()), math.floor(u[inside].max()) + 1)
        assert len(columns) >= 3
        order = np.argsort(u[inside])
        want = np.interp(columns, u[inside][order], v[inside][order])
        np.testing.assert_allclose(peak_rows(image, columns), want, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.JOINTS)
@pytest.mark.parametrize("material", ["mild_steel", "zn_coated"])
def test_the_stripe_pixel_by_pixel(name, material):
    """Ray, irradiance, reflectance, shadow and lens written once more, the rays marched."""
    setup = scenes.setup(name, material, of_camera=sharp(width=161, height=121))
    camera, laser = setup.camera, setup.laser

    def light(T_base_tool, joint, row, column):
        T_tool_base, T_base_camera = invert(T_base_tool), T_base_tool @ camera.T_tool_camera
        ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
        d = T_base_camera[:3, :3] @ ray
        P = T_base_camera[:3, 3] + scenes.march(joint, T_base_camera[:3, 3], d, steps=1000) * d
        normal = scenes.normal_at(joint, P)
        Q = (T_base_tool @ [*laser.origin_in_tool_mm, 1.0])[:3]
        omega_i = (Q - P) / np.linalg.norm(Q - P)
        if omega_i @ normal <= 0.0 or scenes.clearance(joint, P, Q[np.newaxis])[0] < -1e-6:
            return 0.0
        x, y, z = (T_tool_base @ [*P, 1.0])[:3]
        ratio = (140.0 - z) / 140.0
        psi = math.atan2(math.hypot(x - 35.0, y), 140.0 - z)
        sheet = math.exp(-0.5 * ((x - 35.0) / (0.45 * ratio)) ** 2) / ratio**2
        f_r = scenes.f_r(omega_i[np.newaxis], -d / np.linalg.norm(d), normal, setup.material)[0]
        return sheet * float(omega_i @ normal) / math.cos(psi) * f_r / float(ray @ ray) ** 2

    highest = max(range(50, 75), key=lambda row: light(LEVEL, scenes.JOINTS["flat"], row, 80))
    about = highest + np.linspace(-1.0, 1.0, 41)
    peak = max(light(LEVEL, scenes.JOINTS["flat"], row, 80) for row in about)
    # A whole frame has shares where a border crosses a pixel: these are the pixels' centres.
    alone, pixels = Condition(1.0, 0.0, EXPOSURE_S), np.arange(161 * 121)
    image = predict(setup, TURNED, alone, pixels=pixels).mean_e.reshape(121, 161)
    rng = np.random.default_rng(3)
    rows, columns = np.nonzero(image > 50.0)
    chosen = rng.choice(len(rows), 60, replace=False)
    want = [5000.0 / peak * light(TURNED, setup.joint, rows[i], columns[i]) for i in chosen]
    np.testing.assert_allclose(image[rows[chosen], columns[chosen]], want, rtol=1e-3)


@pytest.mark.parametrize(
    "lobe", [Lobe(), Lobe(tail=0.4), Lobe(anisotropy=0.6, marks_deg=30.0)], ids=["gauss", "tail", "marks"]
)
def test_the_sheets_kernel_is_its_plain_twin(lobe):
    setup = scenes.setup("v_groove")
    setup = dataclasses.replace(setup, material=dataclasses.replace(setup.material, lobe=lobe))
    setup = dataclasses.replace(setup, laser=dataclasses.replace(setup.laser, bow=0.2))
    rng = np.random.default_rng(5)
    points = rng.uniform((32.0, -15.0, -6.0), (38.0, 15.0, 3.0), (400, 3))
    normals = rng.normal((0.0, 0.0, 1.0), (0.3, 0.5, 0.2), (400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    T_joint_tool = scenes.pose()
    found = reflected_sheet(setup, points, normals, T_joint_tool)
    plain = reflected_sheet_plain(setup, points, normals, T_joint_tool)
    assert found == pytest.approx(plain, rel=1e-4, abs=1e-9 * plain.max())
    assert np.count_nonzero(plain > 1e-6 * plain.max()) > 20
    assert not reflected_sheet(setup, points * np.nan, normals, T_joint_tool).any()


@pytest.mark.parametrize("half_angle_deg", [None, 24.0])
def test_a_views_stripe_is_the_sheets_light_where_it_is_near_and_not_shaded(half_angle_deg):
    setup = scenes.setup("lap", of_camera=sharp(width=320, height=240))
    origin, half = (35.0, -60.0, 140.0), half_angle_deg
    laser = dataclasses.replace(setup.laser, origin_in_tool_mm=origin, fan_half_angle_deg=half, bow=-0.15)
    setup = dataclasses.replace(setup, laser=laser)
    view = View.of(setup, scenes.pose())
    points, normals, _ = (values.reshape(view.which.size, -1) for values in view.surface)
    near, shaded = (values.ravel() for values in view.sheet)
    lit = near & ~shaded
    plain = np.zeros(len(points))
    plain[lit] = reflected_sheet_plain(setup, points[lit], normals[lit], view.scene.T_joint_tool)
    light = view.laser_e(1000.0)
    wanted = 1000.0 * view.rays.cos4 * plain.reshape(view.shape)
    np.testing.assert_allclose(light, wanted, rtol=1e-4, atol=1e-4 * light.max())
    assert (near & shaded).any()
    assert np.count_nonzero(light > 0.1 * light.max()) > 20


def test_a_laps_edge_throws_a_shadow():
    """From y = -60 the sheet's edge hides the foot up to 2 mm * 60 / 138 beside it."""
    setup = scenes.setup("lap", of_camera=sharp(width=640, height=480))
    laser = dataclasses.replace(setup.laser, origin_in_tool_mm=(35.0, -60.0, 140.0))
    setup = dataclasses.replace(setup, laser=laser)
    image = stripe_alone(setup)
    u, _ = project(setup.camera, np.array([[35.0, 0.0, 0.0], [35.0, 120.0 / 138.0, 0.0]])).T
    brightest = image.max(axis=0)
    # The image's columns run against y.
    np.testing.assert_array_equal(brightest[math.ceil(u[1]) : math.floor(u[0])], 0.0)
    assert brightest[math.floor(u[1]) - 1] > 3000.0
    # The upper sheet, to the right of its edge, is lit.
    assert brightest[math.ceil(u[0]) + 2] > 3000.0


def first_lit_px(image, rows, about):
    """Where the light of some rows begins, by the share of it that each column about that place holds."""
    light = image[rows].sum(axis=0)
    far = np.arange(about + 4, about + 25)
    full = np.polynomial.Polynomial.fit(far, light[far], 1)
    before = np.arange(about - 8, about + 4)
    return about + 3.5 - np.sum(light[before] / full(before))


@pytest.mark.parametrize("off_px", np.arange(10) / 9.0)
def test_a_pixel_holds_both_sides_shares_of_an_edge(off_px):
    """Wherever in a pixel the upper sheet's edge lies, its stripe begins there: columns run against y."""
    setup = scenes.setup("lap", of_camera=sharp(width=640, height=480))
    y_mm = 0.065 * off_px
    image = stripe_alone(setup, seam=SeamLine(y_mm=y_mm))
    (u, v), _ = project(setup.camera, np.array([[35.0, y_mm, 2.0], [35.0, y_mm, 0.0]]))
    # So far below its middle none is left of the lower sheet's stripe, which runs higher.
    rows = slice(round(v) + 14, round(v) + 22)
    assert first_lit_px(image, rows, math.floor(u)) == pytest.approx(u, abs=0.05)


def test_nothing_shines_no_light():
    image = stripe_alone(scenes.setup("lap"), laser_level=0.0)
    np.testing.assert_array_equal(image, 0.0)


def test_light_scales_and_adds():
    setup = scenes.setup("corrugation")
    laser = stripe_alone(setup, TURNED)
    arc = stripe_alone(setup, TURNED, laser_level=0.0, arc_level=1.0)
    both = stripe_alone(setup, TURNED, laser_level=0.7, arc_level=1.3, exposure_s=2.0 * EXPOSURE_S)
    np.testing.assert_allclose(both, 2.0 * (0.7 * laser + 1.3 * arc), rtol=1e-4, atol=1e-2)
    np.testing.assert_array_equal(
        both, stripe_alone(setup, TURNED, laser_level=0.7, arc_level=1.3, exposure_s=0.01)
    )


@pytest.mark.slow
def test_what_only_the_image_shows_renders_nothing_anew(monkeypatch):
    """Levels, exposure, sensor, point-spread function and effects on the image reuse what was rendered."""
    rendered = []
    for owner, name in ((forward, "arc_frame"), (forward.View, "laser_e")):
        original = getattr(owner, name)
        monkeypatch.setattr(
            owner, name, lambda *args, original=original: rendered.append(1) or original(*args)
        )
    setup, renderer = scenes.setup("lap"), Renderer()
    both = Condition(1.0, 1.0, EXPOSURE_S)
    first = predict(setup, TURNED, both, renderer=renderer)
    of_a_pose = len(rendered)
    assert of_a_pose >= 2
    for effect in REGISTRY.values():
        if effect.setup is None or effect.id in ("defocus", "gamma", "black_level", "read_noise"):
            changed = dataclasses.replace(setup, effects=checked({effect.id: effect.typical}))
            predict(changed, TURNED, Condition(0.7, 0.8, 2.0 * EXPOSURE_S, 1.0), renderer=renderer)
    assert len(rendered) == of_a_pose
    again = predict(setup, TURNED, both, renderer=renderer)
    np.testing.assert_array_equal(again.mean_dn, first.mean_dn)
    predict(setup, LEVEL, both, renderer=renderer)
    assert len(rendered) == 2 * of_a_pose


def test_some_pixels_are_those_of_the_frame():
    """Without a point-spread function, which needs the neighbours; a whole frame's arc map is filled."""
    setup = scenes.setup("corrugation", of_camera=sharp())
    both = Condition(1.0, 1.0, EXPOSURE_S)
    pixels = np.arange(7, 160 * 120, 113)
    whole, some = predict(setup, TURNED, both), predict(setup, TURNED, both, pixels=pixels)
    for name in ("mean_e", "variance_e2", "mean_dn", "variance_dn2"):
        # What a saturated pixel scatters falls steeply with its light.
        counts = ~some.saturated if name == "variance_dn2" else np.ones(len(pixels), dtype=bool)
        of_some, of_whole = getattr(some, name)[counts], getattr(whole, name).reshape(-1)[pixels][counts]
        off = np.abs(of_some - of_whole) / (of_some + 1.0)
        assert np.mean(off < FILL_TOLERANCE) > 0.97
        # A ridge's shadow is read off a coarse cell.
        assert off.max() < 10.0 * FILL_TOLERANCE


def test_a_frame_of_many_short_stretches_is_that_of_one():
    """Short stretches are not filled but seen pixel by pixel."""
    setup = scenes.setup("v_groove", of_camera=sharp())
    many = BentSeam.in_stretches(SeamLine, (-100.0, 200.0), 0.0, 40)
    one, other = (Renderer().layers(setup, TURNED, seam).arc_e for seam in (NOMINAL_SEAM, many))
    np.testing.assert_allclose(other, one, rtol=3.0 * FILL_TOLERANCE)


def test_the_arc_is_the_arc_maps():
    setup = scenes.setup("v_groove", of_camera=sharp())
    rays = Rays.of(setup.camera)
    kernel = arc_kernel(setup, make_scene(setup, TURNED))
    mean_e, _ = arc_at(kernel, rays.xy.reshape(-1, 2), rays.cos4.reshape(-1), np.arange(rays.cos4.size))
    image = stripe_alone(setup, TURNED, laser_level=0.0, arc_level=1.0)
    np.testing.assert_allclose(image, mean_e.reshape(120, 160), rtol=3.0 * FILL_TOLERANCE)


def test_the_psf_keeps_the_light_and_widens_the_stripe():
    of_sharp = stripe_alone(scenes.setup("flat", of_camera=sharp()))
    blurred = stripe_alone(scenes.setup("flat"))
    np.testing.assert_allclose(blurred.sum(axis=0), of_sharp.sum(axis=0), rtol=1e-3)
    rows = np.arange(120)

    def variance(column):
        middle = np.sum(rows * column) / np.sum(column)
        return np.sum((rows - middle) ** 2 * column) / np.sum(column)

    assert variance(blurred[:, 80]) - variance(of_sharp[:, 80]) == pytest.approx(0.49, rel=0.02)


def test_a_seam_off_its_line_moves_the_groove():
    setup = scenes.setup("v_groove", of_camera=sharp())
    moved = stripe_alone(setup, seam=SeamLine(y_mm=0.8, z_mm=0.3))
    np.testing.assert_allclose(
        moved, stripe_alone(setup, scenes.pose((0.0, -0.8, -0.3))), rtol=1e-3, atol=1e-2
    )


@pytest.mark.parametrize("on", [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
def test_a_camera_below_the_surface_is_refused(on):
    with pytest.raises(ValueError, match="below the surface"):
        predict(scenes.setup("v_groove"), scenes.pose((0.0, 0.0, -140.0)), Condition(*on, EXPOSURE_S))


def test_past_the_workpiece_it_is_dark():
    setup = scenes.setup(
        "lap", of_camera=scenes.camera(((0.0, 0.0, 60.0), (60.0, 0.0, 57.0)), psf_sigma_px=0.0)
    )
    image = stripe_alone(setup, laser_level=0.0, arc_level=1.0)
    assert np.isfinite(image).all()
    np.testing.assert_array_equal(image[0], 0.0)


@pytest.mark.parametrize("gamma", [1.0, 0.6])
def test_many_frames_have_the_predictions_mean_and_variance(gamma):
    """Whitened residuals of noisy frames: mean 0, variance 1, within what so many draws leave open."""
    setup = scenes.setup("v_groove")
    sensor = dataclasses.replace(
        setup.sensor, bits=12, gain_e_per_dn=10.0, full_well_e=40000.0, black_level_dn=64.0, gamma=gamma
    )
    setup = dataclasses.replace(setup, sensor=sensor)
    condition = Condition(laser_level=1.0, arc_level=0.3, exposure_s=EXPOSURE_S)
    renderer = Renderer()
    expected = predict(setup, TURNED, condition, renderer=renderer)
    inside = ~expected.saturated
    assert np.mean(inside) > 0.9
    rng = np.random.default_rng(2)
    sigma = np.sqrt(expected.variance_dn2)
    n = 24
    frames = [draw_frame(setup, TURNED, condition, rng, renderer=renderer) for _ in range(n)]
    residuals = np.array([((frame - expected.mean_dn) / sigma)[inside] for frame in frames])
    count = residuals.size
    assert abs(residuals.mean()) < 4.0 / math.sqrt(count)
    assert abs(np.mean(residuals**2) - 1.0) < 4.0 * math.sqrt(2.0 / count)
    # Pixel by pixel the frames' mean is the render's.
    assert np.mean(residuals.mean(axis=0) ** 2) * n == pytest.approx(1.0, abs=0.05)
