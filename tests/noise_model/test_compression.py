"""Compression against JPEG as libjpeg writes it, and its variance against frames that are compressed."""

import dataclasses

import cv2
import numpy as np
import pytest
from effect_scenes import CONDITIONS, affected, nominal

from noise_model.effects.compression import compressed, compressed_variance, quantisation_steps
from noise_model.forward import draw_frame

MEAN_DN = (
    20.0
    + 150.0 * np.exp(-0.5 * ((np.arange(120)[:, np.newaxis] - 60.3) / 6.0) ** 2)
    + 20.0 * np.sin(np.arange(160) / 50.0)
)


def noisy(rng, sigma_dn):
    return np.clip(np.rint(MEAN_DN + sigma_dn * rng.standard_normal(MEAN_DN.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("quality", [50, 80, 95])
def test_it_is_what_jpeg_leaves(quality):
    sensor = nominal().sensor
    image = noisy(np.random.default_rng(1), 2.0)
    _, kept = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    expected = cv2.imdecode(kept, cv2.IMREAD_UNCHANGED).astype(float)
    got = compressed(image, sensor, quality).astype(float)
    # Steps are not rounded here: a tenth of them is another multiple.
    assert np.sqrt(np.mean((got - expected) ** 2)) < 0.5 * np.sqrt(np.mean((image - expected) ** 2))
    assert np.mean(np.abs(got - expected) <= 1.0) > 0.8


@pytest.mark.parametrize("sigma_dn", [1.5, 5.0])
@pytest.mark.parametrize("quality", [50, 80, 95])
def test_pixels_scatter_as_predicted(quality, sigma_dn):
    sensor, rng = nominal().sensor, np.random.default_rng(2)
    variance = compressed_variance(MEAN_DN, np.full(MEAN_DN.shape, sigma_dn**2 + 1.0 / 12.0), sensor, quality)
    frames = np.array([compressed(noisy(rng, sigma_dn), sensor, quality) for _ in range(12)], dtype=float)
    assert np.mean((frames - MEAN_DN) ** 2 / variance) == pytest.approx(1.0, abs=0.2)
    # Noise far below the steps is gone where the light is even.
    even = compressed_variance(np.full(5, 80.0), np.full(5, 1.0), sensor, 60)
    assert (even < 0.7).all()


def test_the_best_quality_is_none():
    image = noisy(np.random.default_rng(3), 2.0)
    assert compressed(image, nominal().sensor, 100.0) is image
    assert not quantisation_steps(100.0).any()
    assert quantisation_steps(25.0)[0, 0] == 32.0


def test_a_frame_of_more_bits_is_compressed_alike():
    sensor = dataclasses.replace(nominal().sensor, bits=12, gain_e_per_dn=5.0)
    image = (16.0 * noisy(np.random.default_rng(4), 2.0)).astype(np.uint16)
    fine = compressed(image, sensor, 80.0).astype(float) / 16.0
    coarse = compressed((image / 16).astype(np.uint8), nominal().sensor, 80.0).astype(float)
    assert np.mean(np.abs(fine - coarse) < 1.0) > 0.95


def test_a_drawn_frame_has_its_blocks():
    setup = affected(nominal(), image_compression={"quality": 20.0})
    frame = draw_frame(setup, np.eye(4), CONDITIONS["laser"], np.random.default_rng(5))
    again = compressed(frame, setup.sensor, 20.0)
    # What is at whole steps stays there, but for the rounding to whole DN.
    assert np.mean(np.abs(again.astype(float) - frame) <= 1.0) > 0.99
