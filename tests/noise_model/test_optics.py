import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noise_model.instrument.camera import Camera, Rays, blur, blur_inner, neighbours, undistorted

CAMERA = Camera(
    width=64,
    height=48,
    fx=70.0,
    fy=75.0,
    cx=31.0,
    cy=24.0,
    T_tool_camera=np.eye(4),
    distortion=(-0.12, 0.03, 0.001, -0.0015, 0.01),
)
PLAIN = dataclasses.replace(CAMERA, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
RATIONAL = dataclasses.replace(CAMERA, distortion=(*CAMERA.distortion, 0.05, -0.02, 0.01))
TILTED = dataclasses.replace(
    CAMERA, distortion=(*RATIONAL.distortion, 0.001, -0.002, 5e-4, 0.001, 0.12, -0.07)
)
CAMERAS = pytest.mark.parametrize(
    "camera", [CAMERA, PLAIN, RATIONAL, TILTED], ids=["distorted", "plain", "rational", "tilted"]
)


def all_pixels(camera):
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)


@pytest.mark.parametrize("camera", [CAMERA, PLAIN], ids=["distorted", "plain"])
def test_of_no_points_there_is_none(camera):
    assert camera.normalised(np.empty((0, 2))).shape == (0, 2)
    assert camera.project(np.empty((0, 3))).shape == (0, 2)


@CAMERAS
def test_project_undoes_normalised(camera):
    pixels = all_pixels(camera)
    xy = camera.normalised(pixels)
    rays = np.column_stack([xy, np.ones(len(xy))])
    np.testing.assert_allclose(camera.project(37.0 * rays), pixels, atol=1e-6)


@pytest.mark.parametrize(
    "distortion",
    [(0.2, 5.0, 0.0, 0.0, 0.0), (-0.2, 0.1, *6 * (0.0,), *4 * (0.0,), 0.3, 0.2)],
    ids=["barrel", "tilted"],
)
def test_normalised_holds_where_opencvs_fixed_points_come_near_slowly(distortion):
    camera = dataclasses.replace(PLAIN, distortion=distortion)
    corners = np.array([[0.0, 0.0], [camera.width - 1.0, 0.0], [0.0, camera.height - 1.0]])
    rays = np.column_stack([camera.normalised(corners), np.ones(len(corners))])
    np.testing.assert_allclose(camera.project(rays), corners, atol=1e-6)


@pytest.mark.parametrize("by", [1, 5])
def test_a_coarser_pixel_looks_where_its_fine_ones_do_on_average(by):
    coarse = PLAIN.coarser(by)
    assert (coarse.width, coarse.height) == (PLAIN.width // by, PLAIN.height // by)
    fine = PLAIN.normalised(all_pixels(PLAIN)).reshape(PLAIN.height, PLAIN.width, 2)
    whole = fine[: coarse.height * by, : coarse.width * by].reshape(coarse.height, by, coarse.width, by, 2)
    np.testing.assert_allclose(
        coarse.normalised(all_pixels(coarse)), whole.mean(axis=(1, 3)).reshape(-1, 2), atol=1e-12
    )


@CAMERAS
def test_undistorted_is_opencvs_ray_and_knows_how_it_turns(camera):
    step = 1e-4
    for u, v in all_pixels(camera)[::97]:
        x, y, x_u, x_v, y_u, y_v = undistorted(u, v, camera.intrinsics)
        np.testing.assert_allclose([[x, y]], camera.normalised([[u, v]]), atol=1e-9)
        left, right, up, down = camera.normalised(
            [[u - step, v], [u + step, v], [u, v - step], [u, v + step]]
        )
        np.testing.assert_allclose([x_u, y_u], (right - left) / (2.0 * step), atol=1e-7)
        np.testing.assert_allclose([x_v, y_v], (down - up) / (2.0 * step), atol=1e-7)


@given(st.floats(-0.3, 0.3), st.floats(-0.25, 0.25), st.floats(1.0, 500.0))
def test_normalised_undoes_project(x, y, depth):
    point = depth * np.array([[x, y, 1.0]])
    np.testing.assert_allclose(CAMERA.normalised(CAMERA.project(point)), [[x, y]], atol=1e-9)


def test_the_pinhole_by_hand():
    np.testing.assert_allclose(PLAIN.project(np.array([[1.0, -2.0, 10.0]])), [[31.0 + 7.0, 24.0 - 15.0]])
    np.testing.assert_allclose(PLAIN.normalised([[38.0, 9.0]]), [[0.1, -0.2]])
    np.testing.assert_allclose(PLAIN.matrix @ [0.1, -0.2, 1.0], [38.0, 9.0, 1.0])


def test_radial_distortion_by_hand():
    camera = dataclasses.replace(PLAIN, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    assert camera.project(np.array([[0.2, 0.0, 1.0]]))[0, 0] == pytest.approx(31.0 + 70.0 * 0.2 * 1.004)


@pytest.mark.parametrize("camera", [CAMERA, PLAIN], ids=["distorted", "plain"])
def test_rays_and_fall_off_of_every_pixel(camera):
    rays = Rays.of(camera)
    assert rays.xy.shape == (48, 64, 2)
    assert rays.xy.dtype == rays.cos4.dtype == np.float32
    assert rays.cos4[24, 31] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(rays.xy[5, 60], camera.normalised([[60.0, 5.0]])[0], rtol=1e-6)
    angle = np.arctan(np.linalg.norm(rays.xy.astype(np.float64), axis=-1))
    np.testing.assert_allclose(rays.cos4, np.cos(angle) ** 4, rtol=1e-6)


def test_fall_off_at_45_degrees_is_a_quarter():
    camera = dataclasses.replace(PLAIN, fx=31.0, cx=31.0)
    assert Rays.of(camera).cos4[24, 62] == pytest.approx(0.25)


def point_image(size=61):
    image = np.zeros((size, size), np.float32)
    image[size // 2, size // 2] = 1000.0
    return image


@pytest.mark.parametrize("psf_sigma_px", [0.2, 0.5, 0.65, 0.7, 1.0, 2.0, 3.5])
def test_blur_keeps_energy_and_spreads_by_the_psf(psf_sigma_px):
    image = blur(point_image(), psf_sigma_px).astype(np.float64)
    offset = np.arange(61) - 30.0
    assert image.sum() == pytest.approx(1000.0, rel=1e-5)
    for axis in (0, 1):
        profile = image.sum(axis=axis) / image.sum()
        assert profile @ offset == pytest.approx(0.0, abs=1e-5)
        assert profile @ offset**2 == pytest.approx(psf_sigma_px**2, rel=0.01)


def test_blur_of_an_even_image_changes_nothing_up_to_the_rim():
    even = np.full((30, 40), 123.0, np.float32)
    np.testing.assert_allclose(blur(even, 1.7), even, rtol=1e-5)


def test_some_pixels_are_blurred_as_their_image_is_up_to_the_rim():
    image = np.random.default_rng(1).uniform(0.0, 1000.0, (9, 12)).astype(np.float32)
    inner = np.array([0, 11, 40, 41, 96, 107])
    around = neighbours(inner, image.shape)
    pixels = np.unique(around)
    values = image.reshape(-1)[pixels]
    places = np.searchsorted(pixels, inner)
    blurred = blur_inner(values, places, np.searchsorted(pixels, around), 0.4)
    np.testing.assert_allclose(blurred[places], blur(image, 0.4).reshape(-1)[inner], rtol=1e-5)
    assert np.abs(blurred[places] - values[places]).min() > 1.0
    others = np.setdiff1d(np.arange(len(pixels)), places)
    np.testing.assert_array_equal(blurred[others], values[others])


def test_no_psf_is_no_blur():
    np.testing.assert_array_equal(blur(point_image(), 0.0), point_image())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0),
        ("height", -1),
        ("fx", 0.0),
        ("fy", np.nan),
        ("focal_length_mm", -1.0),
        ("f_number", 0.0),
        ("exposure_s", 0.0),
        ("psf_sigma_px", -0.1),
        ("distortion", (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_an_impossible_camera_is_refused(key, value):
    with pytest.raises(ValueError, match=key):
        dataclasses.replace(CAMERA, **{key: value})
