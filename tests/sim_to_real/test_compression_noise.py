"""Compression is told by a frame's codes, at its quality, and by nothing else."""

import cv2
import numpy as np
import pytest
from small import example_setup

from noise_model.effects.compression import compressed
from sim_to_real.variance.compression import find_compression

SENSOR = example_setup().sensor


def frames(n=4, sigma_dn=1.2, seed=1):
    """Frames (240, 320) of a bent stripe over light that falls off."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:240, :320]
    return [
        np.clip(
            np.rint(
                10.0
                + 40.0 * np.exp(-np.hypot(u - 60.0, v - 200.0) / 150.0)
                + 100.0 * np.exp(-0.5 * ((v - 100.0 - 9.0 * np.sin(u / 30.0) - 2.0 * n) / 5.0) ** 2)
                + sigma_dn * rng.standard_normal(u.shape)
            ),
            0,
            255,
        ).astype(np.uint8)
        for n in range(n)
    ]


def jpeg(image, quality):
    return cv2.imdecode(
        cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_UNCHANGED
    )


@pytest.mark.slow
@pytest.mark.parametrize("quality", [40, 75, 95])
def test_the_quality_is_found(quality):
    for kept in (
        [jpeg(image, quality) for image in frames()],
        [compressed(image, SENSOR, float(quality)) for image in frames()],
    ):
        found = find_compression(kept, SENSOR)
        assert found.evidence > 30.0
        assert found.quality == pytest.approx(quality, abs=1.0)


@pytest.mark.slow
def test_frames_that_were_never_compressed_show_none():
    for seed in range(3):
        assert find_compression(frames(seed=seed), SENSOR).evidence < 0.0
    # Still frames repeat their coefficients, noise or none.
    assert find_compression(4 * frames(1), SENSOR).evidence < 3.0
    assert find_compression(4 * frames(1, sigma_dn=0.3), SENSOR).evidence < 3.0


def test_too_little_structure_tells_nothing():
    dark = [np.full((240, 320), 4, dtype=np.uint8)]
    assert find_compression(dark, SENSOR) is None
