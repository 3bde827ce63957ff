"""The arc map against Mitsuba 3, a path tracer that is not ours: agreement, and times at equal error.

    python benchmarks/path_tracer.py [--samples N]

Every joint in both materials at 640x480, from two poses: the arc to the left and to the right of the seam.

*Agreement*, of `arc_map.arc_frame`: one row of 9x9 blocks in eight, Mitsuba with N paths a pixel. A block is
within 3 % if it deviates by no more than that beyond three of Mitsuba's standard errors.

*Times at equal error*: the error of both is the RMS over lit pixels of the relative error against the exact
image. Of the arc map it is mean((m - a)(m - b) / (a b)) with two independent Mitsuba images a and b, in which
Mitsuba's own noise cancels; the number in brackets is what that noise leaves uncertain, and stands for the
error where that is smaller still: the ratio of times is then a lower limit. Mitsuba's is that of
one multi-jittered set of paths, the best it can do with so many: from sets of 64 and 256 paths follow its
error's fall (about as 1/paths) and the paths that it needs for the arc map's error. Times are CPU seconds
for the 640x480 frame; Mitsuba's leave out the making of scene and kernels, ours leave out nothing.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.arc.map import arc_frame, arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import Joint
from validation.second_renderer.agreement import BLOCK_PX, DARK_E
from validation.second_renderer.blocks import compare_blocks
from validation.second_renderer.path_traced import BATCHES, load_mitsuba, path_traced_arc

POSES = {"left": ((5.0, 3.0, 1.0), (2.0, -3.0, 6.0)), "right": ((8.0, -3.5, 2.0), (-3.0, 4.0, -8.0))}
STRIP_EVERY = 8
SETS = 64, 256
PIXELS = 2048
FEW = 16
"""Pixels of the call whose time is that of making scene and kernels."""


def setup_of(joint_type: str, material: str) -> Setup:
    setup = nominal_setup("v_groove" if joint_type == "flat" else joint_type, material)
    if joint_type == "flat":
        setup = replace(setup, joint=Joint("flat", {}, setup.joint.seam_in_base_mm))
    return balance(setup)


def poses() -> list[np.ndarray]:
    made = []
    for translation_mm, turn_deg in POSES.values():
        T_base_tool = np.eye(4)
        T_base_tool[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
        T_base_tool[:3, 3] = translation_mm
        made.append(T_base_tool)
    return made


def cpu_s(work: Callable[[], object], repeats: int) -> float:
    """CPU seconds of all threads, the least of some repeats."""
    took = []
    for _ in range(repeats):
        started = time.process_time()
        work()
        took.append(time.process_time() - started)
    return min(took)


def row(joint_type: str, material: str, samples: int) -> str:
    setup = setup_of(joint_type, material)
    rays = Rays.of(setup.camera)
    shape = rays.cos4.shape
    rows = np.arange(shape[0]) // BLOCK_PX
    strips = (rows % STRIP_EVERY == 0) & (rows < shape[0] // BLOCK_PX)
    some = np.random.default_rng(0).choice(rays.cos4.size, PIXELS, replace=False)
    blocks, ours, traced, sigmas = [], [], {s: [] for s in (0, 1)}, {s: [] for s in SETS}
    ours_s = mitsuba_s = 0.0

    for seed, T_base_tool in enumerate(poses()):

        def predict(T_base_tool: np.ndarray = T_base_tool) -> np.ndarray:
            kernel = arc_kernel(setup, make_scene(setup, T_base_tool))
            return arc_frame(kernel, rays.xy.reshape(-1, 2), rays.cos4.reshape(-1), shape)

        def trace(
            pixels: np.ndarray, per_set: int, seed: int, T_base_tool: np.ndarray = T_base_tool
        ) -> tuple[np.ndarray, np.ndarray]:
            xy = rays.xy.reshape(-1, 2)[pixels]
            return path_traced_arc(setup, T_base_tool, samples=BATCHES * per_set, seed=seed, xy=xy)

        frame_e = predict()
        ours_s += cpu_s(predict, 5) / len(POSES)
        blocks.append(
            (
                frame_e[strips],
                *path_traced_arc(setup, T_base_tool, samples=samples, seed=seed, xy=rays.xy[strips]),
            )
        )
        ours.append(frame_e.reshape(-1)[some])
        sigmas[SETS[0]].append(trace(some, SETS[0], 10 * seed)[1])
        making_s = cpu_s(lambda: trace(some[:FEW], SETS[1], 0), 1)
        spent_s = []
        for half in traced:
            started = time.process_time()
            mean_e, sigma_e = trace(some, SETS[1], 10 * seed + half + 1)
            spent_s.append(time.process_time() - started)
            traced[half].append(mean_e)
        sigmas[SETS[1]].append(sigma_e)
        # Its kernels are made by now: a call with many pixels less one with few is the paths alone.
        mitsuba_s += (min(spent_s) - making_s) / (BATCHES * SETS[1] * (PIXELS - FEW)) / len(POSES)

    agreement = compare_blocks(*(np.concatenate(part) for part in zip(*blocks, strict=True)))
    image, a, b = (np.concatenate(part) for part in (ours, traced[0], traced[1]))
    lit = np.minimum(a, b) > DARK_E
    image, a, b = image[lit], a[lit], b[lit]
    square = (image - a) * (image - b) / (a * b)
    error = math.sqrt(max(0.0, square.mean()))
    noise = {s: np.concatenate(sigmas[s])[lit] / a for s in SETS}
    doubt = math.sqrt(float(np.mean(noise[SETS[1]] ** 2)) / math.sqrt(len(a)))
    # The scatter of one set, of which the mean is over BATCHES.
    of_set = {s: math.sqrt(BATCHES * float(np.mean(noise[s] ** 2))) for s in SETS}
    fall = math.log(of_set[SETS[0]] / of_set[SETS[1]]) / math.log(SETS[1] / SETS[0])
    needed = SETS[1] * (of_set[SETS[1]] / max(error, doubt)) ** (1.0 / fall)
    mitsuba_frame_s = mitsuba_s * needed * rays.cos4.size
    return (
        f"{joint_type:12} {material:11} {agreement.n_blocks:6d} {agreement.median_ratio:8.4f} "
        f"{agreement.within:8.2%} {agreement.worst:8.2%} {error:8.2%} ({doubt:.2%}) {needed:8.0f} "
        f"{1e3 * ours_s:9.1f} {mitsuba_frame_s:9.1f} {mitsuba_frame_s / ours_s:9.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=256, help="paths a pixel for the agreement")
    samples = parser.parse_args().samples
    mitsuba = load_mitsuba()
    print(__doc__)
    print(f"Mitsuba {mitsuba.__version__}, {samples} paths a pixel for the agreement\n")
    print(
        f"{'':12} {'':11} {'':6} {'median':>8} {'within':>8} {'worst':>8} {'our RMS':>16} {'its':>8} "
        f"{'ours,':>9} {'its,':>9} {'ratio':>9}"
    )
    print(
        f"{'joint':12} {'material':11} {'blocks':>6} {'ratio':>8} {'3 %':>8} {'block':>8} {'error':>16} "
        f"{'paths':>8} {'ms':>9} {'s':>9} {'of times':>9}"
    )
    for joint_type in ("flat", "v_groove", "lap", "corrugation"):
        for material in TABLE_1:
            print(row(joint_type, material, samples), flush=True)


if __name__ == "__main__":
    main()
