"""How much distortion the lens needs: what boards that no fit saw say.

The images are dealt into folds. Each distortion is fitted to all folds but one; the boards of that one then
get a pose each and nothing else, and their residuals count. The best has the least mean square of them. Taken
is the leanest whose mean is within one standard error of the best's, of the differences from board to board
(Breiman et al., Classification and regression trees, 1984, section 3.4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.adjustment import Scene, adjusted
from calibration.camera.lens import ORDERS, TILT
from calibration.camera.noise import Noise
from calibration.camera.sightings import Sightings
from noise_model.arrays import Float64

MOST_FOLDS = 10


@dataclass(frozen=True)
class Held:
    """How well a distortion predicts boards that its fit did not see.

    Parameters
    ----------
    name : str
        The distortion, one of `ORDERS`.
    loss : array (V,)
        Each board's mean square of residuals over sigma, when held out.
    scene : Scene
        The scene of all boards.
    """

    name: str
    loss: Float64
    scene: Scene

    @property
    def mean(self) -> float:
        """The mean over boards; 1 if noise were all."""
        return float(self.loss.mean())

    def excess(self, best: Held) -> tuple[float, float]:
        """Return by how much the mean is above that of the best, and the standard error of this."""
        worse = self.loss - best.loss
        return float(worse.mean()), float(worse.std(ddof=1) / np.sqrt(len(worse)))


def held_out_errors(
    scene: Scene,
    seen: Sightings,
    noise: Noise,
    orders: Sequence[str],
    *,
    tilted: bool,
    progress: Callable[[int], None] | None = None,
) -> list[Held]:
    """Return how well each distortion predicts, the leanest first.

    Parameters
    ----------
    scene : Scene
        Where each starts.
    seen : Sightings
        The corners, without wrong ones.
    noise : Noise
        Their noise, the same for all distortions.
    orders : sequence of str
        The distortions of `ORDERS` to try.
    tilted : bool
        Let the sensor be tilted, too.
    progress : callable, optional
        Told how many distortions are done.

    Returns
    -------
    list of Held
        One for each distortion.
    """
    held = []
    for n, name in enumerate(orders):
        lens = scene.lens.with_distortion((*ORDERS[name], *(TILT if tilted else ())))
        whole = adjusted(replace(scene, lens=lens), seen, noise.weight(seen))
        # With nothing to choose from, nothing need be held out.
        losses = _losses(whole, seen, noise) if len(orders) > 1 else np.ones(len(seen.names))
        held.append(Held(name, losses, whole))
        if progress is not None:
            progress(n + 1)
    return held


def leanest_within_error(held: list[Held]) -> Held:
    """Return the leanest distortion that predicts as well as the best, within one standard error."""
    best = min(held, key=lambda each: each.mean)
    for each in held:
        worse, error = each.excess(best)
        if worse <= error:
            return each
    return best


def _losses(whole: Scene, seen: Sightings, noise: Noise) -> Float64:
    views = len(seen.names)
    folds = np.arange(views) % min(MOST_FOLDS, views)
    losses = np.empty(views)
    for fold in range(folds.max() + 1):
        kept, held = np.flatnonzero(folds != fold).tolist(), np.flatnonzero(folds == fold).tolist()
        corners = seen.of_views(kept)
        trained = adjusted(whole.of_views(kept), corners, (1.0 / noise.sigma_px[kept])[corners.view])
        others = seen.of_views(held)
        weight = (1.0 / noise.sigma_px[held])[others.view]
        start = replace(trained, T_camera_board=whole.T_camera_board[held])
        posed = adjusted(start, others, weight, poses_only=True)
        squares = np.sum((posed.residuals(others) * weight[:, None]) ** 2, axis=1)
        free = 2.0 * others.counts - 6.0
        losses[held] = [squares[part].sum() / dof for part, dof in zip(others.slices, free, strict=True)]
    return losses
