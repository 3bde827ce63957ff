"""Lines that stand out on both sides."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from sim_to_real.variance.streaks import KERNELS, N_ANGLES, NOISE_GAIN, line_response

SHAPE = (60, 80)


def beside_line(angle, shape=SHAPE):
    """The distance (h, w) of pixels from a line through the middle."""
    row, column = np.indices(shape) - (np.array(shape) / 2.0)[:, None, None]
    return row * math.cos(angle) - column * math.sin(angle)


def test_means_along_a_line_weigh_one():
    assert KERNELS.sum(axis=(1, 2)) == pytest.approx(np.ones(N_ANGLES))


@pytest.mark.parametrize("turn", range(N_ANGLES))
def test_a_line_answers_in_its_own_direction(turn):
    angle = math.pi * turn / N_ANGLES
    image = 7.0 * np.exp(-0.5 * (beside_line(angle) / 0.6) ** 2).astype(np.float32)
    middle = line_response(image).bright[:, SHAPE[0] // 2, SHAPE[1] // 2]
    assert int(np.argmax(middle)) == turn
    assert 0.5 * 7.0 < middle.max() <= 7.0


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9, 1.6, 2.7])
def test_edges_and_slopes_are_no_lines(angle):
    beside = beside_line(angle)
    edge = 50.0 / (1.0 + np.exp(-beside / 0.4))
    inside = np.s_[:, 8:-8, 8:-8]
    for image in (edge, 0.7 * beside):
        response = line_response(image.astype(np.float32))
        # Edges step from pixel to pixel: a share of theirs is left.
        assert response.bright[inside].max() < 0.02 * 50.0
        assert response.dark[inside].max() < 0.02 * 50.0


def test_what_is_bright_in_an_image_is_dark_in_its_negative():
    image = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)
    assert line_response(-image).bright == pytest.approx(line_response(image).dark, abs=1e-6)


def test_noise_alone_exceeds_its_bound_no_more_often_than_a_normal_variable():
    image = np.random.default_rng(1).normal(0.0, 2.0, (400, 500)).astype(np.float32)
    response = line_response(image)
    for sigmas in (1.0, 2.0, 3.0):
        for responses in (response.bright, response.dark):
            assert np.mean(responses > sigmas * 2.0 * NOISE_GAIN) < norm.sf(sigmas)
