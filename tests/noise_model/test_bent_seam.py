"""A seam that bends, as straight stretches."""

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from noise_model.forward import Renderer
from noise_model.surface import BentSeam, SeamLine

POSE = np.eye(4)
SETUP = nominal_setup("v_groove", "mild_steel", width=64, height=48)


def at(station_mm, slope_y=0.02):
    """A tangent of the same straight line: y = 0.3 + slope_y x."""
    return SeamLine(station_mm, 0.3 + slope_y * station_mm, 0.1, slope_y, 0.0)


def layers(seam, setup=SETUP):
    return Renderer().layers(setup, POSE, seam)


@pytest.mark.parametrize("joint", ["v_groove", "lap", "corrugation"])
def test_stretches_of_a_straight_seam_are_that_seam(joint):
    setup = nominal_setup(joint, "mild_steel", width=64, height=48)
    whole = layers(at(35.0), setup)
    pieces = layers(BentSeam(tuple(at(x) for x in (25.0, 31.0, 38.0, 46.0)), at(35.0)), setup)
    np.testing.assert_allclose(pieces.arc_e, whole.arc_e, atol=5e-3 * whole.arc_e.max())
    np.testing.assert_allclose(pieces.laser_e, whole.laser_e, atol=1e-4 * whole.laser_e.max())
    assert whole.arc_e.max() > 0.0
    assert whole.laser_e.max() > 0.0


def test_each_stretch_is_seen_where_it_lies():
    left, right = SeamLine(25.0, -1.0), SeamLine(45.0, 1.0)
    bent = layers(BentSeam((left, right), SeamLine()))
    x = bent.view.surface[0][..., 0]
    for line, where in ((left, x < 34.5), (right, x > 35.5)):
        alone = layers(line)
        np.testing.assert_array_equal(bent.laser_e[where], alone.laser_e[where])


def test_the_arc_stands_on_the_ground_that_is_named():
    lap = nominal_setup("lap", "mild_steel", width=64, height=48)
    line = SeamLine(35.0)
    low, high = (layers(BentSeam((line,), SeamLine(0.0, 0.0, z)), lap) for z in (0.0, 1.0))
    assert high.view.scene.center_mm[2] - low.view.scene.center_mm[2] == pytest.approx(1.0)
    assert not np.allclose(low.arc_e, high.arc_e)


def test_an_edge_hides_the_arc_where_it_passes_it_not_where_a_tangent_points():
    lap = nominal_setup("lap", "mild_steel", width=64, height=48)
    line = SeamLine(35.0, 0.0, 0.0, 0.02)
    # The tangent passes the torch 0.7 mm to the right, the seam itself 0.4 mm to the left.
    bent = layers(BentSeam((line,), SeamLine(0.0, 0.4)), lap)
    straight = layers(BentSeam((line,), SeamLine(0.0, -0.7)), lap)
    whole = layers(line, lap).arc_e
    np.testing.assert_allclose(straight.arc_e, whole, rtol=1e-3, atol=1e-3 * whole.max())
    assert bent.view.scene.center_mm[1] - straight.view.scene.center_mm[1] == pytest.approx(-1.1, abs=1e-3)


def test_stretches_out_of_order_are_refused():
    with pytest.raises(ValueError, match="rising order"):
        BentSeam((at(30.0), at(20.0)), SeamLine())
    with pytest.raises(ValueError, match="rising order"):
        BentSeam((), SeamLine())
