"""The renderer's medium: a point's airlight in closed form; fume and glow are the same from every pose."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from validation.second_renderer.world_medium import even_fume, exponential_glow, fume_along


def test_an_even_fumes_airlight_is_the_closed_form() -> None:
    eye, arc = np.array([95.0, 0.0, 130.0]), np.zeros(3)
    to = np.array([[30.0, -15.0, 0.0], [36.0, 0.0, 0.0], [50.0, 10.0, -3.0]])
    length = np.linalg.norm(to - eye, axis=1)
    rays = (to - eye) / length[:, np.newaxis]
    optical, air = fume_along(eye, rays, length, arc, 3.0, lambda points, r: np.ones_like(r))
    t_0 = -(rays @ eye)
    D = np.sqrt(eye @ eye - t_0**2)
    exact = (np.arctan((length - t_0) / D) + np.arctan(t_0 / D)) / D
    np.testing.assert_allclose(optical, length)
    np.testing.assert_allclose(air, exact, rtol=2e-3)


def test_a_pose_nearer_to_the_arc_sees_more_of_the_same_fume() -> None:
    """As much more as the integral along its ray says: the recording has one fume, not one for each frame."""
    setup = nominal_setup("v_groove", "mild_steel")
    found = []
    for higher_mm in (0.0, 3.0):
        eye = setup.camera.T_tool_camera[:3, 3] + [0.0, 0.0, higher_mm]
        ray = setup.camera.T_tool_camera[:3, 2][np.newaxis]
        length = -eye[2] / ray[:, 2]
        frame = SimpleNamespace(
            sight=SimpleNamespace(
                eye_mm=eye, directions=ray, distance_mm=length, cos4=np.ones(1), shape=(1, 1)
            ),
            body=SimpleNamespace(center_mm=np.zeros(3), radius_mm=3.0),
            studio=SimpleNamespace(world=SimpleNamespace(setup=setup)),
            moment=SimpleNamespace(arc_level=1.0),
            arc=np.zeros((1, 1)),
            scale=lambda factor: None,
        )
        even_fume(frame, {"extinction_per_m": 1.0, "airlight_share": 0.05})
        _, air = fume_along(eye, ray, length, np.zeros(3), 3.0, lambda points, r: np.ones_like(r))
        found.append((frame.arc.item(), air.item()))
    assert found[0][0] == pytest.approx(0.05 * setup.sensor.full_well_e)
    assert found[1][0] / found[0][0] == pytest.approx(found[1][1] / found[0][1])
    assert found[1][0] != pytest.approx(found[0][0], rel=1e-3)


def test_a_place_on_the_plate_glows_alike_from_every_pose() -> None:
    """A camera that comes nearer to the arc sees hotter metal, and what it saw before as hot as before."""
    setup = nominal_setup("v_groove", "mild_steel")
    places = np.array([[20.0, 0.0, 0.0], [36.0, 5.0, 0.0], [45.0, -3.0, 0.0]])
    found = []
    for chosen in (slice(0, 3), slice(1, 3)):
        points = places[chosen]
        frame = SimpleNamespace(
            sight=SimpleNamespace(points=points, cos4=np.ones(len(points)), shape=(len(points),)),
            body=SimpleNamespace(center_mm=np.zeros(3)),
            studio=SimpleNamespace(world=SimpleNamespace(setup=setup)),
            moment=SimpleNamespace(arc_level=1.0),
            other=np.zeros(len(points)),
        )
        exponential_glow(frame, {"brightest_e": 3000.0, "length_mm": 10.0})
        found.append(frame.other)
    np.testing.assert_allclose(found[0][1:], found[1])
    rho = np.linalg.norm(places[:, :2], axis=1)
    np.testing.assert_allclose(found[0] / found[0][0], np.exp(-(rho - rho[0]) / 10.0))
    # Near the image's rim it is about as bright as it was drawn.
    assert 0.3 < found[0][0] / 3000.0 < 3.0
