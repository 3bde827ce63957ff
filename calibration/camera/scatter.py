"""Do images agree with each other as well as the noise of their corners lets them?

Corners of one image may err together: the board is not as it was printed, it moved, light shifts its edges.
Then images differ by more than their corners' noise. With u_i an image's pull on lens and warp at the
solution, S_i its information on them, and S their sum with the lens' prior,

    sum u_i' S^-1 u_i   is expected to be   sum tr(S^-1 S_i) - sum tr((S^-1 S_i)²)

The ratio of both is by how much the covariance is too small. It is roughly chi² over its m degrees of
freedom.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from calibration.camera.adjustment import BoardScene, with_prior
from calibration.camera.normal_equations import scaled_inverse
from calibration.camera.sightings import Sightings
from calibration.outliers import FALSE_ALARM
from noise_model.compiled.arrays import Float64


def scatter_between_images(scene: BoardScene, seen: Sightings, weight: Float64) -> float:
    """Return the images' scatter over that which the noise predicts; 1 where that is not significant.

    By this factor the covariance of lens and warp is too small. `weight` (N,) are the corners' 1 / sigma,
    1/px.
    """
    equations = with_prior(scene, seen, weight)
    parts = equations.view_information()
    covariance = scaled_inverse(equations.information())
    gradients = equations.view_gradients()
    share = covariance @ parts
    expected = float(np.trace(share.sum(axis=0)) - np.einsum("vij,vji->", share, share))
    ratio = float(np.einsum("vi,ij,vj->", gradients, covariance, gradients)) / expected
    return ratio if chi2.sf(ratio * len(covariance), len(covariance)) < FALSE_ALARM else 1.0
