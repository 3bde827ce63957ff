"""Blocks of pixels, and the neighbourhood of a pixel."""

from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Bool, Float32, Float64, Integers, UInt8

Kind = TypeVar("Kind", bound=np.generic)

DETAIL_2X2 = np.array([[0.5, -0.5], [-0.5, 0.5]], dtype=np.float32)
"""The weights of a 2 x 2 Haar detail: 0 for smooth light, with the variance of a pixel's noise."""


def in_blocks(images: npt.NDArray[Kind], side_px: int) -> npt.NDArray[Kind]:
    """Return images (..., H, W) in square blocks (..., h, side_px, w, side_px).

    A rest at the rim that fills no block is left out.
    """
    h, w = images.shape[-2] // side_px, images.shape[-1] // side_px
    whole = images[..., : h * side_px, : w * side_px]
    return whole.reshape(*images.shape[:-2], h, side_px, w, side_px)


def block_means(image: npt.NDArray[np.generic], side_px: int) -> Float64:
    """Return the means (h, w) of an image's (H, W) whole blocks."""
    return np.asarray(in_blocks(image, side_px).mean(axis=(-3, -1), dtype=np.float64))


def weighted_sums_in_bins(image: Float32, weights: Float32, bin_px: int) -> Float32:
    """Return the weighted sums (h, w, m) of the squares of pixels (k, k) that lie in each bin of an image."""
    side = len(weights)
    n = bin_px // side
    bins = in_blocks(np.asarray(cv2.filter2D(image, -1, weights, anchor=(0, 0)), dtype=np.float32), bin_px)
    chosen = bins[:, : n * side : side, :, : n * side : side].transpose(0, 2, 1, 3)
    return np.ascontiguousarray(chosen).reshape(*chosen.shape[:2], n * n)


def dilate(mask: Bool, side_px: int) -> Bool:
    """Return a mask (H, W) dilated by a square, an odd number of pixels wide."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _box(side_px)) > 0)


def near_face_edges(faces: Integers, side_px: int) -> Bool:
    """Return the pixels (H, W) that see no face of the joint, or whose square about them sees several."""
    face = faces.astype(np.float32)
    square = _box(side_px)
    return np.asarray((cv2.dilate(face, square) != cv2.erode(face, square)) | (face < 0))


def _box(side_px: int) -> UInt8:
    return np.ones((side_px, side_px), dtype=np.uint8)
