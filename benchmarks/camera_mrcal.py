"""The same corners through arctrack and through mrcal: projections and their sigmas side by side.

    python benchmarks/camera_mrcal.py [--worlds WORLDS] [--seed SEED]

It needs mrcal (`pip install mrcal`: wheels for Python 3.12 and 3.13), NumPy, SciPy and OpenCV. Cameras and
corners are those of camera_worlds.py, all with one noise. Neither estimator rejects or regularises. Compared
are 48 points of the image at the boards' median depth: how far apart both see a point of space, once the
camera frames are brought together by the boards, and the ratio of the sigmas that they state.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from importlib import metadata
from typing import TYPE_CHECKING

import numpy as np
from calibrate_camera import board_of, views_of
from camera_worlds import World, draw_corners, draw_world
from scipy.spatial.transform import Rotation

from calibration.camera.adjustment import BoardScene, adjust, linearise
from calibration.camera.lens import Lens
from calibration.camera.projection import Knowledge, rms_sigma
from calibration.camera.sightings import Sightings
from calibration.camera.start import first_scene, with_better_poses
from noise_model.compiled.arrays import Float64

if TYPE_CHECKING:
    import mrcal

MODELS = {"k1 k2 p1 p2": "LENSMODEL_OPENCV4", "k1 k2 p1 p2 k3": "LENSMODEL_OPENCV5"}


@dataclass(frozen=True)
class Compared:
    """How far apart both see points (n, 2), px, the sigmas that they state (n,), px, and their seconds."""

    apart_px: Float64
    ours_px: Float64
    theirs_px: Float64
    by_mean_px: Float64
    seconds: tuple[float, float]


def compare(world: World, images: list[Float64]) -> Compared:
    """Return what both make of the same corners."""
    # Here, so that the command line is read without it.
    import mrcal

    seen = Sightings.of(board_of(world), views_of(images))
    start = first_scene(*world.size, seen)
    names = tuple(world.order.split())
    start = replace(start, lens=start.lens.with_distortion(names))
    began = time.perf_counter()
    # mrcal is run without a prior on lenses: such weights leave ours none.
    weight = np.full(len(seen), 1e3)
    ours = adjust(with_better_poses(adjust(start, seen, weight), seen), seen, weight)
    free = 2 * len(seen) - len(ours.lens.values) - 2 - 6 * len(images)
    sigma = float(np.sqrt(np.sum(ours.residuals(seen) ** 2) / free))
    known = Knowledge.of(linearise(ours, seen, np.full(len(seen), 1.0 / sigma)))
    middle = time.perf_counter()
    theirs, model = optimised(world, images, ours)
    ended = time.perf_counter()
    depth = float(np.median(ours.points_camera(seen)[:, 2]))
    shares = np.stack(np.meshgrid(np.linspace(0.05, 0.95, 8), np.linspace(0.05, 0.95, 6)), axis=-1)
    points_px = shares.reshape(-1, 2) * world.size
    points = ours.lens.rays(points_px) * depth
    motion = common_motion(ours, theirs, seen)
    moved = points + np.cross(motion[:3], points) + motion[3:]
    return Compared(
        theirs.lens.project(moved) - points_px,
        rms_sigma(known.projection_covariance(ours.lens, points_px, depth)),
        *(
            mrcal.projection_uncertainty(
                moved, model, method=method, what="rms-stdev", observed_pixel_uncertainty=sigma
            )
            for method in ("cross-reprojection-rrp-Jfp", "mean-pcam")
        ),
        (middle - began, ended - middle),
    )


def optimised(world: World, images: list[Float64], start: BoardScene) -> tuple[BoardScene, mrcal.cameramodel]:
    """Return mrcal's scene and its model; it starts at ours, some of its sigmas off."""
    import mrcal

    columns, rows = world.counts
    frames = np.array(
        [[*Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]] for T in start.T_camera_board]
    )
    observed = np.ones((len(images), rows, columns, 3))
    observed[..., :2] = np.reshape(images, (len(images), rows, columns, 2))
    views = np.arange(len(images))
    inputs = {
        "lensmodel": MODELS[world.order],
        "intrinsics": (start.lens.values * 1.001)[np.newaxis].copy(),
        "rt_cam_ref": None,
        "rt_ref_frame": frames,
        "points": None,
        "observations_board": observed,
        "indices_frame_camintrinsics_camextrinsics": np.column_stack(
            [views, 0 * views, 0 * views - 1]
        ).astype(np.int32),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "imagersizes": np.array([world.size], dtype=np.int32),
        "calobject_warp": np.zeros(2),
        "calibration_object_spacing": world.square_mm,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_frames": True,
        "do_optimize_extrinsics": False,
        "do_optimize_calobject_warp": True,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
        "verbose": False,
    }
    mrcal.optimize(**inputs)
    lens = Lens(*world.size, start.lens.names, inputs["intrinsics"][0].copy())
    T = np.tile(np.eye(4), (len(images), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(inputs["rt_ref_frame"][:, :3]).as_matrix()
    T[:, :3, 3] = inputs["rt_ref_frame"][:, 3:]
    model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0)
    return BoardScene(lens, inputs["calobject_warp"].copy(), T, start.print_mm), model


def common_motion(first: BoardScene, second: BoardScene, seen: Sightings) -> Float64:
    """Return the small motion (6,) of the camera frame that brings the first's boards to the second's."""
    between = second.T_camera_board @ np.linalg.inv(first.T_camera_board)
    small = np.concatenate([Rotation.from_matrix(between[:, :3, :3]).as_rotvec(), between[:, :3, 3]], axis=1)
    D = linearise(first, seen, np.ones(len(seen))).motion
    return np.asarray(np.linalg.solve(D.sum(axis=0), np.einsum("vij,vj->i", D, small)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    results = []
    for n in range(options.worlds):
        rng = np.random.default_rng([options.seed, 2, n])
        world = draw_world(rng, list(MODELS)[n % len(MODELS)])
        world.sigma_px[:] = np.median(world.sigma_px)
        results.append(compare(world, draw_corners(rng, world)[0]))
    apart = np.array([np.linalg.norm(result.apart_px, axis=1).max() for result in results])
    print(f"{options.worlds} worlds, seed {options.seed}, mrcal {metadata.version('mrcal')}")
    print(f"projections apart: {np.median(apart):.2g} px in the median world, {apart.max():.2g} px at most")
    for name, ratios in (
        ("cross-reprojection", [np.median(result.ours_px / result.theirs_px) for result in results]),
        ("mean-pcam", [np.median(result.ours_px / result.by_mean_px) for result in results]),
    ):
        print(
            f"our sigma over mrcal's {name}: median {np.median(ratios):.3f}, "
            f"worlds from {min(ratios):.3f} to {max(ratios):.3f}"
        )
    ours, theirs = np.median([result.seconds for result in results], axis=0)
    print(f"seconds: ours {ours:.2f}, mrcal {theirs:.2f}")


if __name__ == "__main__":
    main()
