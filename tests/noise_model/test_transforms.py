import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from noise_model.transforms import invert, pose_matrix, transform

coordinates = st.floats(-1000.0, 1000.0)
vectors = st.tuples(coordinates, coordinates, coordinates)
components = st.floats(-1.0, 1.0)


@st.composite
def poses(draw):
    quaternion = np.array(draw(st.tuples(components, components, components, components)))
    norm = np.linalg.norm(quaternion)
    assume(norm > 0.1)
    return pose_matrix(draw(vectors), quaternion / norm)


@given(poses())
def test_a_pose_is_rigid_and_right_handed(T_a_b):
    np.testing.assert_allclose(T_a_b[:3, :3] @ T_a_b[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T_a_b[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_array_equal(T_a_b[3], [0.0, 0.0, 0.0, 1.0])


@given(poses())
def test_a_pose_and_its_inverse_make_the_identity(T_a_b):
    np.testing.assert_allclose(invert(T_a_b) @ T_a_b, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(T_a_b @ invert(T_a_b), np.eye(4), atol=1e-9)


@given(poses(), poses(), vectors)
def test_poses_compose_by_their_product(T_a_b, T_b_c, point_c):
    points_c = np.array([point_c])
    np.testing.assert_allclose(
        transform(T_a_b @ T_b_c, points_c), transform(T_a_b, transform(T_b_c, points_c)), atol=1e-8
    )
    np.testing.assert_allclose(invert(T_a_b @ T_b_c), invert(T_b_c) @ invert(T_a_b), atol=1e-8)


@given(poses(), vectors, vectors)
def test_distances_stay(T_a_b, one, other):
    points_b = np.array([one, other])
    points_a = transform(T_a_b, points_b)
    assert np.linalg.norm(points_a[0] - points_a[1]) == pytest.approx(
        np.linalg.norm(points_b[0] - points_b[1]), abs=1e-8
    )


def test_a_quarter_turn_about_z_by_hand():
    T_a_b = pose_matrix([10.0, 20.0, 30.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(transform(T_a_b, np.array([1.0, 0.0, 0.0])), [10.0, 21.0, 30.0], atol=1e-12)
    np.testing.assert_allclose(invert(T_a_b)[:3, 3], [-20.0, 10.0, -30.0], atol=1e-12)


def test_points_keep_their_shape():
    assert transform(np.eye(4), np.zeros((4, 5, 3))).shape == (4, 5, 3)


def test_a_quaternion_a_little_off_is_normalised_and_its_sign_does_not_matter():
    T_a_b = pose_matrix(np.zeros(3), [0.0, 0.0, 0.0, 1.005])
    np.testing.assert_array_equal(T_a_b, np.eye(4))
    np.testing.assert_array_equal(pose_matrix(np.zeros(3), [0.0, 0.0, 0.0, -1.0]), np.eye(4))


@pytest.mark.parametrize(
    ("translation", "quaternion", "message"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], "no rotation"),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.02], "no rotation"),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, np.nan], "finite"),
        ([0.0, np.inf, 0.0], [0.0, 0.0, 0.0, 1.0], "finite"),
        ([0.0, 0.0], [0.0, 0.0, 0.0, 1.0], "needs 3"),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], "needs 3"),
    ],
)
def test_what_is_no_pose_is_refused(translation, quaternion, message):
    with pytest.raises(ValueError, match=message):
        pose_matrix(translation, quaternion)
