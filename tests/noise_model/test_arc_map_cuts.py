"""Whether metal cuts into the arc: the kernel beside the surface's height, drawn at random."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noise_model.arc.map import CUT_MM, ON_HALF_SPHERE, any_below
from noise_model.surface.joint import Joint, corrugation_height, section

SIZES = {
    "lap": {"thickness_mm": 2.0},
    "corrugation": {"thickness_mm": 1.5, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0},
}


@pytest.mark.parametrize("joint_type", SIZES)
@given(st.floats(-40.0, 40.0), st.floats(-6.0, 6.0), st.floats(-2.0, 12.0), st.floats(0.5, 4.0))
def test_a_point_is_below_where_the_surface_is_higher(joint_type, x, y, z, radius):
    shape = section(Joint(joint_type, SIZES[joint_type], ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0))))
    points = np.array([x, y, z]) + radius * ON_HALF_SPHERE
    heights = np.interp(points[:, 1], *shape.vertices.T) + corrugation_height(points[:, 0], shape.corrugation)
    depth = heights - points[:, 2]
    # On the surface itself rounding decides.
    if np.abs(depth - CUT_MM).min() > 1e-9:
        expected = bool((depth > CUT_MM).any())
        assert any_below((x, y, z), radius, ON_HALF_SPHERE, shape.vertices, shape.corrugation) == expected
