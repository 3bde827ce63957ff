"""The arc map's time against its error: a 1280x1024 frame and the stripe's band, for a new pose, one core.

    taskset -c 0 python benchmarks/arc_map.py [--repeats 7] [--joints v_groove lap] [--mitsuba-samples 64]

Errors are those against each pixel's own integral at 24 by 12 nodes, on every 7th pixel, in units of 0.5 % of
the local light or 0.25 DN, whichever is more. Times are the least of the repeats, CPU time: `pose` is what
scene and kernel take, `map` the filling. Beside them: brute force (each pixel's integral at the same nodes),
one memory pass (np.copyto of the frame) and, where it is installed, Mitsuba. Each level of interpolation is
timed on the band, for a torch that stands upright at its stated height, 0.1 mm beside the seam.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import numpy as np

from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.arc.baked import NOTHING_BAKED, BakedLight
from noise_model.arc.map import (
    CELL,
    NODES_P,
    NODES_Q,
    TOLERANCE,
    ArcKernel,
    ArcMap,
    arc_at,
    arc_kernel,
)
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.setup import Setup
from tracker.geometry import MAP_FLOOR_E, MAP_TOLERANCE, SensorGeometry
from tracker.stripe.band import FIT_SIGMAS, place
from tracker.stripe.expected import expect_stripe

JOINTS = {"v_groove": "mild_steel", "lap": "zn_coated", "corrugation": "zn_coated"}
SETTINGS = [
    (tolerance, nodes)
    for nodes in ((4, 2), (NODES_P, NODES_Q), (12, 6))
    for tolerance in (0.02, 0.01, TOLERANCE, 0.0025)
]
BAND_MM = 1.0


def min_ms(function: Callable[[], object], repeats: int) -> float:
    function()
    took = []
    for _ in range(repeats):
        started = time.process_time()
        function()
        took.append(time.process_time() - started)
    return 1e3 * min(took)


def pose() -> Float64:
    """Return T_base_tool 6 mm on, 0.5 mm beside the seam, 1 mm up, tilted and turned by 2 to 4 degrees."""
    rx, ry, rz = np.radians([2.0, -3.0, 4.0])
    T = np.eye(4)
    c, s = np.cos, np.sin
    R_x = np.array([[1.0, 0.0, 0.0], [0.0, c(rx), -s(rx)], [0.0, s(rx), c(rx)]])
    R_y = np.array([[c(ry), 0.0, s(ry)], [0.0, 1.0, 0.0], [-s(ry), 0.0, c(ry)]])
    R_z = np.array([[c(rz), -s(rz), 0.0], [s(rz), c(rz), 0.0], [0.0, 0.0, 1.0]])
    T[:3, :3], T[:3, 3] = R_z @ R_y @ R_x, (6.0, 0.5, 1.0)
    return T


def measure(joint: str, repeats: int) -> Setup:
    setup = balance(nominal_setup(joint, JOINTS[joint], width=1280, height=1024))
    quarter_dn = 0.25 * setup.sensor.gain_e_per_dn
    geometry = SensorGeometry.of(setup)
    T = pose()
    scene = make_scene(setup, T)
    pixels = np.arange(0, geometry.cos4.size, 7)
    want, _ = arc_at(arc_kernel(setup, scene, nodes=(24, 12)), geometry.xy, geometry.cos4, pixels)
    frame = np.empty((geometry.n_scan, geometry.n_pos), dtype=np.float32)
    no_lows = np.zeros(-(-geometry.n_scan // CELL), dtype=np.int64)
    expected = expect_stripe(geometry, scene)
    assert expected is not None
    half = math.ceil(BAND_MM * geometry.pixels_per_mm + FIT_SIGMAS * float(expected.sigma_px.max()))
    lows = np.empty_like(no_lows)
    depth = place(expected.position_px, geometry.n_pos, half, lows)
    band = np.empty((geometry.n_scan, depth), dtype=np.float32)
    source = np.ones_like(frame)
    copy = min_ms(lambda: np.copyto(frame, source), 5 * repeats)
    new = min_ms(lambda: arc_kernel(setup, make_scene(setup, T)), repeats)
    print(f"\n{joint}, {JOINTS[joint]}: pose {new:.2f} ms; memory pass {copy:.2f} ms; band {band.shape}")
    print("  nodes  tolerance | frame, ms  / pass |  band, ms | error: median    p99    max   beyond")
    for tolerance, nodes in SETTINGS:
        kernel = arc_kernel(setup, scene, nodes=nodes)

        def fill(
            lows: Int64 = no_lows,
            out: Float32 = frame,
            kernel: ArcKernel = kernel,
            tolerance: float = tolerance,
        ) -> None:
            ArcMap.of(kernel, geometry.xy, geometry.cos4, len(out), tolerance, quarter_dn).fill(lows, out)

        whole = min_ms(fill, repeats)
        error = np.abs(frame.reshape(-1)[pixels] - want) / np.maximum(0.005 * want, quarter_dn)
        part = min_ms(lambda fill=fill: fill(lows, band), repeats)
        print(
            f"  {nodes[0]:2d}x{nodes[1]:d}   {tolerance:8.2%} | {whole:9.2f} {whole / copy:7.1f} | "
            f"{part:9.2f} | {np.nanmedian(error):13.3f} {np.nanquantile(error, 0.99):6.2f} "
            f"{np.nanmax(error):6.2f} {np.nanmean(error > 1.0):8.3%}"
        )
    kernel = arc_kernel(setup, scene)
    some = pixels[::10]
    brute = min_ms(lambda: arc_at(kernel, geometry.xy, geometry.cos4, some), 2) / len(some)
    n = NODES_P * NODES_Q
    print(
        f"  brute force {NODES_P}x{NODES_Q}: {1e6 * brute:.0f} ns a pixel, {1e6 * brute / n:.1f} ns a node "
        f"and pixel, {brute * geometry.cos4.size:.0f} ms a frame, "
        f"{brute * geometry.cos4.size / copy:.0f} memory passes"
    )
    return setup


def levels(setup: Setup, repeats: int) -> None:
    """Print the time of the tracker's band with one level of interpolation more each."""
    geometry, T = SensorGeometry.of(setup), np.eye(4)
    T[:3, 3] = 6.0, 0.1, 0.0
    scene = make_scene(setup, T)
    kernel, expected = arc_kernel(setup, scene), expect_stripe(geometry, scene)
    assert expected is not None
    half = math.ceil(BAND_MM * geometry.pixels_per_mm + FIT_SIGMAS * float(expected.sigma_px.max()))
    lows = np.zeros(-(-geometry.n_scan // CELL), dtype=np.int64)
    band = np.empty((geometry.n_scan, place(expected.position_px, geometry.n_pos, half, lows)), np.float32)
    first = np.arange(geometry.n_scan) * geometry.n_pos + lows[np.arange(geometry.n_scan) // CELL]
    pixels = (first[:, None] + np.arange(band.shape[1])).ravel()

    def light(baked: BakedLight = NOTHING_BAKED) -> ArcMap:
        camera = geometry.xy, geometry.cos4, geometry.n_scan
        return ArcMap.of(kernel, *camera, MAP_TOLERANCE, MAP_FLOOR_E, baked)

    some = pixels[::50]
    own = min_ms(lambda: arc_at(kernel, geometry.xy, geometry.cos4, some), 2) * len(pixels) / len(some)
    times = {
        "each pixel's own integral": own,
        "read off the faces' tables": min_ms(lambda: light().at(pixels), repeats),
        "cells of the image": min_ms(lambda: light().fill(lows, band), repeats),
        "baked tables": min_ms(lambda: light(geometry.baked_light).fill(lows, band), repeats),
    }
    print(f"  band {band.shape}: " + "; ".join(f"{level} {took:.2f} ms" for level, took in times.items()))


def beside_mitsuba(setup: Setup, samples: int) -> None:
    try:
        from validation.second_renderer.path_traced import path_traced_arc

        rng = np.random.default_rng(0)
        geometry = SensorGeometry.of(setup)
        xy = geometry.xy[rng.choice(len(geometry.xy), 20_000, replace=False)]
        path_traced_arc(setup, pose(), samples=samples, xy=xy)
        started = time.process_time()
        mean_e, sigma_e = path_traced_arc(setup, pose(), samples=samples, seed=1, xy=xy)
    except (ImportError, ValueError) as error:
        print(f"  Mitsuba: {error}")
        return
    took = time.process_time() - started
    lit = mean_e > 0.25 * setup.sensor.gain_e_per_dn
    noise = float(np.median(sigma_e[lit] / mean_e[lit]))
    per_pixel = 1e6 * took / len(xy)
    print(
        f"  Mitsuba, {samples} samples: {per_pixel:.1f} us a pixel, Monte-Carlo noise {noise:.1%}; "
        f"at 0.5 % {1e-3 * per_pixel * (noise / 0.005) ** 2 * geometry.cos4.size:.0f} ms a frame"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--joints", nargs="+", choices=list(JOINTS), default=list(JOINTS))
    parser.add_argument("--mitsuba-samples", type=int, default=64)
    options = parser.parse_args()
    for joint in options.joints:
        setup = measure(joint, options.repeats)
        levels(setup, options.repeats)
        beside_mitsuba(setup, options.mitsuba_samples)


if __name__ == "__main__":
    main()
