"""Printing errors of a board's corners, from the corners' residuals.

Every image shows the same board. So printing errors are common to all images, unlike the noise of an image's
corners. With S and g the information on all corners' places and the gradient on them, lens, warp and poses
eliminated, and S = V diag(l) V':

    y = V' o + V' g / l   is normal about 0 with the variance   tau² + 1 / l

o are the places so far, tau is 1 sigma of the print. Where l is 0 the board as a whole is moved, turned or
scaled: that is no error of the print.
"""

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from calibration.boards.board import Board, BoardKind
from calibration.camera.adjustment import BoardScene, linearise, prior_precision, shared_values
from calibration.camera.noise import CornerNoise
from calibration.camera.sightings import Sightings

FALSE_ALARM = 1e-3
"""The probability that an exact board is taken for one that is not."""

UNSEEN = 1e-9
"""Information below this share of the largest is none."""

MIN_SHARE, MAX_SHARE = 1e-6, 0.1
"""1 sigma of a print over the squares' side, at least and at most."""


def has_distinct_ends(board: Board) -> bool:
    """Return True if corners are numbered alike in all images, however the board is turned.

    Half a turn leaves a chessboard as it is unless one of its sides is odd and the other even.
    """
    return board.kind is BoardKind.CHARUCO or (board.columns + board.rows) % 2 == 1


def print_sigma_mm(scene: BoardScene, seen: Sightings, noise: CornerNoise) -> float:
    """Return 1 sigma of the corners' places on the board, along each axis, mm; 0 where noise explains all.

    It is the maximum of the likelihood at the scene of least squares.
    """
    n = len(scene.lens.values) + 2
    prior = np.pad(prior_precision(scene), (0, scene.print_mm.size))
    equations = linearise(scene, seen, noise.weight(seen), with_print=True).with_prior(
        prior, shared_values(scene)
    )
    information, pull = equations.information(), equations.pull()
    solved = np.linalg.solve(information[:n, :n], information[:n, n:])
    information = information[n:, n:] - information[n:, :n] @ solved
    pull = pull[n:] - solved.T @ pull[:n]
    eigenvalues, basis = np.linalg.eigh(0.5 * (information + information.T))
    kept = eigenvalues > UNSEEN * eigenvalues.max()
    eigenvalues, basis = eigenvalues[kept], basis[:, kept]
    places = basis.T @ scene.print_mm.ravel() + (basis.T @ pull) / eigenvalues
    if chi2.sf(float(np.sum(places**2 * eigenvalues)), len(eigenvalues)) > FALSE_ALARM:
        return 0.0

    def cost(log_sigma: float) -> float:
        variance = np.exp(2.0 * log_sigma) + 1.0 / eigenvalues
        return float(np.sum(np.log(variance) + places**2 / variance))

    side = seen.board.square_mm
    bounds = np.log(MIN_SHARE * side), np.log(MAX_SHARE * side)
    return float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded").x))
