"""Start of the adjustment: a focal length from a scan, and a pose for each image.

Zhang's closed form has no answer where boards lie parallel to the sensor, and a single board of wrong corners
spoils it. A scan has one: the focal length at which most boards fit, by the median of their residuals.
"""

from dataclasses import replace

import cv2
import numpy as np

from calibration.camera.adjustment import BoardScene, adjust
from calibration.camera.lens import Lens
from calibration.camera.sightings import Sightings
from noise_model.compiled.arrays import Float64


def first_scene(width: int, height: int, seen: Sightings) -> BoardScene:
    """Return a start: a lens without distortion, a flat board, and its poses.

    Its focal length is that at which the median board fits best.
    """
    # Fields of view from 103 down to 3 deg.
    lenses = [Lens.simple(width, height, focal) for focal in np.geomspace(0.4, 20.0, 24) * max(width, height)]
    exact = np.zeros((len(seen.board.points_mm), 2))
    scenes = [BoardScene(lens, np.zeros(2), _poses(lens, seen), exact) for lens in lenses]
    misfits = [float(np.median(_squares(scene, seen))) for scene in scenes]
    return scenes[int(np.argmin(misfits))]


def with_better_poses(scene: BoardScene, seen: Sightings) -> BoardScene:
    """Return the scene with each board's pose estimated again, where that explains its corners better.

    A distant board looks much the same when it is tilted the other way. The adjustment does not get from one
    to the other.
    """
    ones = np.ones(len(seen))
    best, squares = scene, _squares(scene, seen)
    for mirrored in (False, True):
        posed = replace(scene, T_camera_board=_poses(scene.lens, seen, mirrored))
        other = adjust(posed, seen, ones, poses_only=True)
        anew = _squares(other, seen)
        better = anew < squares
        T = np.where(better[:, None, None], other.T_camera_board, best.T_camera_board)
        best, squares = replace(scene, T_camera_board=T), np.minimum(anew, squares)
    return best


def _poses(lens: Lens, seen: Sightings, mirrored: bool = False) -> Float64:
    """Return the pose (V, 4, 4) of a flat board that fits each image best, or the second best."""
    T = np.tile(np.eye(4), (len(seen.names), 1, 1))
    flat, rays = seen.flat_mm, np.ascontiguousarray(lens.rays(seen.points_px)[:, :2])
    for n, part in enumerate(seen.slices):
        _, turns, moves, _ = cv2.solvePnPGeneric(
            flat[part], rays[part].reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        chosen = min(int(mirrored), len(turns) - 1)
        T[n, :3, :3] = cv2.Rodrigues(turns[chosen])[0]
        T[n, :3, 3] = moves[chosen].ravel()
    return T


def _squares(scene: BoardScene, seen: Sightings) -> Float64:
    """Return the mean square of each image's residuals (V,), px²."""
    squares = np.sum(scene.residuals(seen) ** 2, axis=1)
    return np.asarray([squares[part].mean() for part in seen.slices])
