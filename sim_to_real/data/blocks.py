"""Pixels taken together: the whole blocks of an image, and what lies around a pixel."""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from noise_model.arrays import Bool, Float32, Float64, Integers, UInt8

Kind = TypeVar("Kind", bound=np.generic)

SMALL = np.array([[0.5, -0.5], [-0.5, 0.5]], dtype=np.float32)
"""The detail of 2 x 2 pixels that no smooth light has: its variance is that of a pixel's noise."""


def cut(images: npt.NDArray[Kind], side_px: int) -> npt.NDArray[Kind]:
    """Return images (..., H, W) in square blocks (..., h, side_px, w, side_px).

    A rest at the rim that fills no block is left out.
    """
    h, w = images.shape[-2] // side_px, images.shape[-1] // side_px
    whole = images[..., : h * side_px, : w * side_px]
    return whole.reshape(*images.shape[:-2], h, side_px, w, side_px)


def block_means(image: npt.NDArray[np.generic], side_px: int) -> Float64:
    """Return the means (h, w) of an image's (H, W) whole blocks."""
    return np.asarray(cut(image, side_px).mean(axis=(-3, -1), dtype=np.float64))


def in_bins(image: Float32, weights: Float32, bin_px: int) -> Float32:
    """Return the weighted sums (h, w, m) of the squares of pixels (k, k) that lie in each bin of an image."""
    side = len(weights)
    n = bin_px // side
    bins = cut(np.asarray(cv2.filter2D(image, -1, weights, anchor=(0, 0)), dtype=np.float32), bin_px)
    chosen = bins[:, : n * side : side, :, : n * side : side].transpose(0, 2, 1, 3)
    return np.ascontiguousarray(chosen).reshape(*chosen.shape[:2], n * n)


def within(mask: Bool, side_px: int) -> Bool:
    """Return the pixels (H, W) about which a square, an odd number of pixels wide, holds one of a mask's."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _square(side_px)) > 0)


def off_faces(faces: Integers, side_px: int) -> Bool:
    """Return the pixels (H, W) that see no face of the joint, or others than all of the square about them."""
    face = faces.astype(np.float32)
    square = _square(side_px)
    return np.asarray((cv2.dilate(face, square) != cv2.erode(face, square)) | (face < 0))


def _square(side_px: int) -> UInt8:
    return np.ones((side_px, side_px), dtype=np.uint8)
