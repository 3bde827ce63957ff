"""The same corners through arctrack and through OpenCV's calibrateCamera: errors and sigmas side by side.

    python benchmarks/camera_opencv.py [--worlds WORLDS] [--seed SEED] [--flat]

Cameras, bent boards and corners are those of camera_worlds.py, without wrong corners. Both are told which
coefficients of the distortion are free. Printed are RMS errors over the Cramer-Rao bound, RMS errors over the
sigma that each states, and how often its 95 % interval holds the truth.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import cv2
import numpy as np
from calibrate_camera import board_of, bound, views_of
from camera_worlds import LENSES, World, draw_corners, draw_world
from scipy.stats import norm

from calibration.camera.calibrate import fit_lens
from calibration.camera.enough import UndeterminedError
from noise_model.compiled.arrays import Float64

OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
FIXED = {"k1": cv2.CALIB_FIX_K1, "k2": cv2.CALIB_FIX_K2, "k3": cv2.CALIB_FIX_K3}


def by_opencv(world: World, images: list[Float64]) -> tuple[dict[str, float], dict[str, float]]:
    """Return OpenCV's values and its standard deviations."""
    flat = board_of(world).points_mm.astype(np.float32)
    points = [image.astype(np.float32).reshape(-1, 1, 2) for image in images]
    flags = sum(flag for name, flag in FIXED.items() if name not in LENSES[world.order])
    if "p1" not in LENSES[world.order]:
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    _, matrix, distortion, _, _, deviations, _, _ = cv2.calibrateCameraExtended(
        [flat] * len(points), points, world.size, None, None, flags=flags
    )
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]]
    return (
        dict(zip(OPENCV, map(float, values), strict=True)),
        dict(zip(OPENCV, map(float, deviations.ravel()[:9]), strict=True)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--flat", action="store_true", help="boards are flat")
    options = parser.parse_args()
    scores: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for n in range(options.worlds):
        rng = np.random.default_rng([options.seed, 4, n])
        world = draw_world(rng, list(LENSES)[n % len(LENSES)])
        if options.flat:
            world = replace(world, warp_mm=np.zeros(2))
        images, _ = draw_corners(rng, world)
        try:
            result = fit_lens(board_of(world), views_of(images), world.size, orders=[world.order])
        except UndeterminedError:
            continue
        least = dict(zip(result.names, bound(world, result), strict=True))
        names = result.scene.lens.names
        ours = (
            dict(zip(names, result.scene.lens.values, strict=True)),
            dict(zip(result.names, result.sigma, strict=True)),
        )
        for who, (values, sigmas) in (("arctrack", ours), ("OpenCV", by_opencv(world, images))):
            for name in names:
                error = values[name] - world.lens[name]
                scores.setdefault((who, name), []).append((error / least[name], error / sigmas[name]))
    print(f"{options.worlds} worlds, seed {options.seed}")
    print("                     error/bound   error/sigma   95 %")
    for (who, name), pairs in sorted(scores.items(), key=lambda item: (OPENCV.index(item[0][1]), item[0][0])):
        over_bound, over_sigma = (np.array(column) for column in zip(*pairs, strict=True))
        covered = 100.0 * np.mean(np.abs(over_sigma) <= norm.isf(0.025))
        bound_rms, sigma_rms = (np.sqrt(np.mean(ratio**2)) for ratio in (over_bound, over_sigma))
        print(f"{name:6} {who:10} {bound_rms:13.2f} {sigma_rms:13.2f} {covered:7.1f}")


if __name__ == "__main__":
    main()
