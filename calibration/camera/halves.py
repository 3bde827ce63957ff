"""Cross-validation: two halves of the images must say the same of the lens, within what they claim to know.

Each half gives a lens. The camera frames of both differ by a small motion, which is fitted. What is left of
the difference between their projections is compared with the sigma that both predict. More than twice that
is no noise: the model is wrong (mrcal's documentation, "cross-validation").
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from calibration.camera.adjustment import BoardScene, with_prior
from calibration.camera.lens import Lens
from calibration.camera.noise import fit_scene
from calibration.camera.normal_equations import scaled_inverse
from calibration.camera.projection import image_grid
from calibration.camera.sightings import Sightings
from noise_model.compiled.arrays import Bool, Float64

MAX_RATIO = 2.0
"""Largest difference that a right model explains, in predicted sigmas."""

SEED = 7


@dataclass(frozen=True)
class Difference:
    """Difference of two lenses of the same camera.

    At `points_px` (N, 2) the second's projection less the first's is `shift_px` (N, 2); `sigma_px` (N,) is
    its predicted sigma, RMS over directions.
    """

    points_px: Float64
    shift_px: Float64
    sigma_px: Float64

    @property
    def ratio(self) -> float:
        """The RMS of the difference over that which is predicted."""
        return float(np.sqrt(np.sum(self.shift_px**2) / (2.0 * np.sum(self.sigma_px**2))))


def splits(views: int) -> list[Bool]:
    """Return partitions (V,) of `views` images into halves."""
    rng = np.random.default_rng(SEED)
    alternate = np.arange(views) % 2 == 0
    # Every second image, and eight drawings at random: the median of nine decides.
    return [alternate, *(rng.permutation(alternate) for _ in range(8))]


def difference_of_halves(scene: BoardScene, seen: Sightings, first: Bool) -> Difference:
    """Return the difference between the lenses of two sets of images, where boards were seen.

    Both halves start at `scene`, that of all images; `seen` has no wrong corners; `first` (V,) selects the
    first half.
    """
    lenses, covariances = [], []
    for half in (first, ~first):
        chosen = np.flatnonzero(half).tolist()
        corners = seen.select_views(chosen)
        own, noise = fit_scene(scene.select_views(chosen), corners)
        equations = with_prior(own, corners, noise.weight(corners))
        lenses.append(own.lens)
        # Both halves share the prior: they differ by their corners' noise alone.
        C = scaled_inverse(equations.information())
        covariances.append((C @ equations.view_information().sum(axis=0) @ C)[:-2, :-2])
    depths_mm = np.quantile(scene.points_camera(seen)[:, 2], [0.05, 0.95])
    grid, _ = image_grid(scene.lens)
    grid = grid[Delaunay(seen.points_px).find_simplex(grid) >= 0]
    return _difference(lenses[0], lenses[1], covariances[0] + covariances[1], grid, depths_mm)


def _difference(
    first: Lens, second: Lens, covariance: Float64, grid: Float64, depths_mm: Float64
) -> Difference:
    rays = first.rays(grid)
    points = np.concatenate([rays * depth for depth in depths_mm])
    target = np.tile(grid, (len(depths_mm), 1))
    R, t = np.eye(3), np.zeros(3)
    for _ in range(5):
        image, per_motion, per_lens = second.project_with_jacobian(points @ R.T + t)
        shift = image - target
        J = per_motion.reshape(-1, 6)
        step = -np.linalg.lstsq(J, shift.ravel(), rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        R, t = turn @ R, turn @ t + step[3:]
    # What the fitted motion takes out of the noise, it takes out of the prediction too.
    Q = per_lens.reshape(len(J), -1)
    Q = Q - J @ np.linalg.lstsq(J, Q, rcond=None)[0]
    variance = np.einsum(
        "nij,jk,nik->n", Q.reshape(-1, 2, Q.shape[1]), covariance, Q.reshape(-1, 2, Q.shape[1])
    )
    return Difference(target, shift, np.sqrt(0.5 * variance))
