"""Two images of the arc's light compared by block means, one of them with a Monte-Carlo error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float64
from sim_to_real.data.blocks import in_blocks
from validation.second_renderer.agreement import BLOCK_PX, DARK_E

TOLERANCE, SIGMAS = 0.03, 3.0
"""A block agrees within this of the reference, beyond so many standard errors of its mean."""


@dataclass(frozen=True)
class BlockAgreement:
    """How a prediction and a reference agree over the `n_blocks` blocks that are not dark in both.

    `median_ratio` of prediction over reference; `within` the share of blocks that agree; `worst` the largest
    deviation beyond the Monte-Carlo error, relative to the reference. Dark is what stays below `DARK_E`.
    """

    n_blocks: int
    median_ratio: float
    within: float
    worst: float


def compare_blocks(
    predicted_e: npt.NDArray[np.floating], reference_e: Float64, sigma_e: Float64
) -> BlockAgreement:
    """Compare images (H, W), e-, block by block; `sigma_e` is the reference's standard error per pixel.

    Pixels that are NaN in both are left out; a block in which a pixel is NaN in one alone does not agree. A
    rest at the rim that fills no block is left out. Raises ValueError if every block is dark in both.
    """
    predicted, reference, variance = (_blocks(image) for image in (predicted_e, reference_e, sigma_e**2))
    both = np.isfinite(predicted) & np.isfinite(reference)
    one_alone = (np.isfinite(predicted) != np.isfinite(reference)).any(axis=-1)
    count = np.maximum(both.sum(axis=-1), 1)
    means = [np.where(both, image, 0.0).sum(axis=-1) / count for image in (predicted, reference)]
    sigma = np.sqrt(np.where(both, variance, 0.0).sum(axis=-1)) / count
    lit = one_alone | (np.maximum(*means) > DARK_E)
    if not lit.any():
        raise ValueError("every block is dark: nothing can be compared")
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = np.maximum(np.abs(means[0] - means[1]) - SIGMAS * sigma, 0.0) / means[1]
        ratio = means[0] / means[1]
    beyond = np.where(lit, np.where(one_alone | np.isnan(beyond), np.inf, beyond), 0.0)
    return BlockAgreement(
        int(lit.sum()),
        float(np.median(ratio[lit & ~one_alone])),
        float(np.mean(beyond[lit] <= TOLERANCE)),
        float(beyond.max()),
    )


def _blocks(image: npt.NDArray[np.floating]) -> Float64:
    """Return the whole blocks of an image (H, W) as (h, w, BLOCK_PX^2)."""
    blocks = in_blocks(image.astype(np.float64), BLOCK_PX).swapaxes(1, 2)
    return np.ascontiguousarray(blocks).reshape(*blocks.shape[:2], BLOCK_PX**2)
