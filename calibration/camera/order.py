"""Choice of the lens' distortion by cross-validation: how well the other boards predict each.

Each board in turn is held out. The others give a lens, the board gets a pose under it and nothing else, and
its residuals count. `held_out` chooses by them, and by the evidence: the marginal likelihood under the prior
on lenses, by Laplace's approximation.

    2 ln Z = -chi² - ln |S| + sum ln precision

No fit is repeated. With S the information of all boards and the prior on lens and warp, S_i that of board i,
u_i its pull and c_i its sum of squares, the others alone move lens and warp by one step, and board i has then

    ds = -(S - S_i)^-1 u_i,   c_i - 2 u_i' ds + ds' S_i ds
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera.adjustment import BoardScene, adjust, with_prior
from calibration.camera.lens import ORDERS, TILT
from calibration.camera.noise import CornerNoise
from calibration.camera.normal_equations import scaled_inverse
from calibration.camera.sightings import Sightings
from calibration.held_out import HeldOutScore


@dataclass(frozen=True)
class DistortionScore(HeldOutScore):
    """Cross-validation of a distortion of `ORDERS`: losses are in sigmas; `scene` is that of all boards.

    The mean loss is 1 if noise were all.
    """

    scene: BoardScene


def cross_validate(
    scene: BoardScene,
    seen: Sightings,
    noise: CornerNoise,
    orders: Sequence[str],
    *,
    tilted: bool,
    progress: Callable[[int], None] | None = None,
) -> list[DistortionScore]:
    """Return the prediction error of each distortion on boards held out of its fit, the leanest first.

    All start at `scene` and share `noise`; `seen` has no wrong corners. `tilted` adds a tilt of the sensor;
    `progress` is called with the number of distortions done.
    """
    scores = []
    for n, name in enumerate(orders):
        lens = scene.lens.with_distortion((*ORDERS[name], *(TILT if tilted else ())))
        whole = adjust(replace(scene, lens=lens), seen, noise.weight(seen))
        scores.append(_score(name, whole, seen, noise))
        if progress is not None:
            progress(n + 1)
    return scores


def _score(name: str, whole: BoardScene, seen: Sightings, noise: CornerNoise) -> DistortionScore:
    weight = noise.weight(seen)
    equations = with_prior(whole, seen, weight)
    parts, gradients, information = (
        equations.view_information(),
        equations.view_gradients(),
        equations.information(),
    )
    residuals = np.sum((whole.residuals(seen) * weight[:, None]) ** 2, axis=1)
    squares = np.array([residuals[part].sum() for part in seen.slices])
    steps = np.stack([-scaled_inverse(information - S) @ u for S, u in zip(parts, gradients, strict=True)])
    held_out = (
        squares - 2.0 * np.sum(gradients * steps, axis=1) + np.einsum("vi,vij,vj->v", steps, parts, steps)
    )
    precision = whole.lens.prior_precision()
    chi2 = squares.sum() + np.sum(precision * whole.lens.values**2)
    occam = np.log(precision[precision > 0.0]).sum() - np.linalg.slogdet(information)[1]
    return DistortionScore(name, held_out / (2.0 * seen.counts - 6.0), 0.5 * float(occam - chi2), whole)
