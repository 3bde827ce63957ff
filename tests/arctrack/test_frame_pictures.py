"""Pictures of frames and points for pages, held against what they are by definition."""

import math

import numpy as np
import pytest

from arctrack.replay.pages.view import points_json
from arctrack.report.image import shrunk


@pytest.mark.parametrize("bin_px", [1, 2, 3])
def test_a_picture_shrinks_to_the_means_of_its_bins(bin_px: int) -> None:
    grey = np.random.default_rng(1).integers(0, 256, (49, 64), dtype=np.uint8)
    h, w = 49 // bin_px, 64 // bin_px
    bins = grey[: h * bin_px, : w * bin_px].reshape(h, bin_px, w, bin_px)
    expected = bins.mean(axis=(1, 3)).round().astype(np.uint8)
    np.testing.assert_array_equal(shrunk(grey, bin_px), expected)


def test_points_are_whole_numbers_or_none() -> None:
    points = np.array([[1.24, -3.26], [math.nan, 2.0], [5.0, math.nan], [0.06, 0.0]])
    assert points_json(points, 10.0) == [[12, -33], None, None, [1, 0]]
    assert points_json(points[:0], 10.0) == []
