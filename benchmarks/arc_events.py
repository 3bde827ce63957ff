"""Events of an arc by its light, told in their frame, false answers, and the arc's height.

    python benchmarks/arc_events.py rendered [--scenes 30] [--seed 20000]
    python benchmarks/arc_events.py noise [--frames 100000] [--seed 1]
    python benchmarks/arc_events.py height [--scenes 30] [--seed 20000] [--arc on|welding]

Rendered: scenes of `random_scene.py` with all that welding adds, no light of which is the forward model's.
Their arc is off, ignites, burns, and goes out while it is said to burn. Noise: each of twelve such scenes is
rendered once with and once without its arc; its noise, the arc's breathing and the hall's light are drawn
anew for each frame, and the arc goes on and off in one of 50. Height: such scenes whose arc stands -1 to 2 mm
off its stated height, 0.3 mm aside, and is 5 % larger or smaller.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator

import numpy as np

from arctrack.replay.arc_height import ArcDeparture, ArcHeight, ArcHeightEstimator
from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from tracker import flags
from tracker.arc.burning import NOTHING_SEEN, arc_evidence
from tracker.arc.level import Unlit, estimate_arc_level
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose
from tracker.stripe.read import arc_map_of
from tracker.tracker import Tracker
from validation.anywhere.random_scene import RandomScene, draw_scene, world_of
from validation.anywhere.swept_world import SweptWorld

SWITCHES = 1 / 50
"""Share of the frames in which the arc goes on or off."""

BREATH, NOISE_SCENES = 0.15, 12
EVENTS = flags.ARC_IGNITED.mask | flags.ARC_LOST.mask
WRONG_WORD = flags.ARC_NOT_SEEN.mask | flags.ARC_UNANNOUNCED.mask


def scenes(seed: int, n: int, n_frames: int, arc: str) -> Iterator[RandomScene]:
    """Yield scenes that the setup's checks let pass."""
    while n > 0:
        scene = draw_scene(seed, n_frames, arc)
        seed += 1
        if scene.arc_on and scene.setup.arc.radiance_e > 0.0:
            n -= 1
            yield scene


def print_rendered(n_scenes: int, seed: int) -> None:
    """Track each scene's arc off, on, on, off, the last two with a word that is wrong every other scene."""
    counts: Counter[str] = Counter()
    for number, scene in enumerate(scenes(seed, n_scenes, 5, "welding")):
        tracker, world = Tracker(scene.setup), world_of(scene)
        light = scene.setup.camera.exposure_s, scene.setup.arc.current_a
        for n, (burns, stated) in enumerate(
            [(False, False), (True, True), (True, number % 2 == 0), (False, True), (False, False)]
        ):
            rng = np.random.default_rng([scene.seed, 9, n])
            image_dn = world.frame(scene.poses[n], True, burns, rng)
            track = tracker.step(Frame(n, 0.1 * n, image_dn, *light, True, stated), Pose(scene.poses[n]))
            wanted = flags.ARC_IGNITED if n == 1 else flags.ARC_LOST if n == 3 else None
            counts["frames"] += 1
            counts["events"] += wanted is not None
            counts["in their frame"] += wanted is not None and bool(track.flags & wanted.mask)
            counts["false events"] += wanted is None and bool(track.flags & EVENTS)
            counts["wrong words"] += burns is not stated
            counts["flagged"] += burns is not stated and bool(track.flags & WRONG_WORD)
            counts["right words flagged"] += burns is stated and bool(track.flags & WRONG_WORD)
            evidence = None if tracker.reading is None else tracker.reading.evidence
            counts["open"] += evidence is None or evidence.burns is None
    print(", ".join(f"{name} {count}" for name, count in counts.items()))


def print_noise(n_frames: int, seed: int) -> None:
    """Draw the noise of each frame's sample anew, and hold each answer against what was drawn."""
    rng, counts = np.random.default_rng(seed), Counter[str]()
    drawn = scenes(20000, NOISE_SCENES, 1, "on")
    for scene in drawn:
        geometry, T_base_tool = SensorGeometry.of(scene.setup), scene.poses[0]
        image, world = geometry.image_source, world_of(scene)
        arc_e, dark_e = sampled(geometry, world, T_base_tool)
        kernel = arc_kernel(scene.setup, make_scene(scene.setup, T_base_tool))
        pixels = image.level_scan * image.n_pos + image.level_position
        map_e = np.asarray(arc_map_of(geometry, kernel).at(pixels), np.float64)
        seen = np.isfinite(map_e)
        burns, memory, sensor = False, NOTHING_SEEN, scene.setup.sensor
        for _ in range(n_frames // NOISE_SCENES):
            switched = rng.random() < SWITCHES
            burns ^= switched
            level = math.exp(BREATH * rng.standard_normal()) if burns else 0.0
            mean_e = level * arc_e + math.exp(0.02 * rng.standard_normal()) * dark_e
            charge_e = rng.poisson(mean_e) + sensor.read_noise_e * rng.standard_normal(len(mean_e))
            code = np.rint(charge_e / sensor.gain_e_per_dn + sensor.black_level_dn)
            code = code.clip(0, 2**sensor.bits - 1).astype(np.int64)
            kept = seen & (code < image.saturation_dn)
            unlit = Unlit(map_e[kept], np.asarray(image.charge_e, np.float64)[code[kept]], pixels[kept])
            evidence = arc_evidence(image, unlit, estimate_arc_level(image, unlit), memory.hall_e)
            before, memory = memory.burns, memory.after(evidence, 1.0)
            counts["frames"] += 1
            counts["open"] += evidence.burns is None
            counts["false"] += evidence.burns is not None and evidence.burns is not burns
            counts["switches"] += switched
            counts["in their frame"] += switched and before is not None and memory.burns is burns
    print(", ".join(f"{name} {count}" for name, count in counts.items()))


def print_heights(n_scenes: int, seed: int, arc: str) -> None:
    """Estimate the height of arcs that stand off their place; print error, sigma and their ratio."""
    z, errors_mm, sigmas_mm, level_z = [], [], [], []
    unknown: Counter[str] = Counter()
    for scene in scenes(seed, n_scenes, 3, arc):
        draw, world = np.random.default_rng([scene.seed, 8]), world_of(scene)
        there = ArcDeparture(draw.uniform(-1.0, 2.0), *draw.normal(0.0, 0.3, 2), draw.normal(1.0, 0.05))
        world = SweptWorld(there.applied_to(world.setup), scene.world, scene.speckle, scene.around)
        tracker = Tracker(scene.setup)
        estimator = ArcHeightEstimator(tracker.geometry)
        light = scene.setup.camera.exposure_s, scene.setup.arc.current_a, True, True
        for n, T_base_tool in enumerate(scene.poses):
            image_dn = world.frame(T_base_tool, True, True, np.random.default_rng([scene.seed, 9, n]))
            frame = Frame(n, 0.1 * n, image_dn, *light)
            track, reading = tracker.step(frame, Pose(T_base_tool)), tracker.reading
            height = (
                ArcHeight(unknown="not_tracked")
                if reading is None
                else estimator.of_track(frame, Pose(T_base_tool), reading.seam, track)
            )
            if height.unknown:
                unknown[height.unknown] += 1
                continue
            errors_mm.append(height.height_mm - there.height_mm)
            sigmas_mm.append(height.height_sigma_mm)
            z.append(errors_mm[-1] / sigmas_mm[-1])
            level_z.append((height.level - 1.0) / height.level_sigma)
    print(f"{len(z)} heights, {dict(unknown)}: error median {np.median(np.abs(errors_mm)):.3f}, RMS ", end="")
    print(
        f"{np.sqrt(np.mean(np.square(errors_mm))):.3f} mm; sigma median {np.median(sigmas_mm):.3f} mm; ",
        end="",
    )
    print(
        f"error/sigma RMS {np.sqrt(np.mean(np.square(z))):.2f}, median of |.| {np.median(np.abs(z)):.2f}, ",
        end="",
    )
    print(f"largest {np.max(np.abs(z)):.1f}; output's RMS {np.sqrt(np.mean(np.square(level_z))):.2f}")


def sampled(geometry: SensorGeometry, world: SweptWorld, T_base_tool: Float64) -> tuple[Float64, Float64]:
    """Return the light (n,) of arc and of all else at the level's sample, e-, by a world without noise."""
    image = geometry.image_source
    lit_e, _ = world.mean_light(T_base_tool, False, True)
    dark_e, _ = world.mean_light(T_base_tool, False, False)
    where = (image.level_position, image.level_scan)
    if not image.along_rows:
        where = where[::-1]
    return np.maximum(lit_e - dark_e, 0.0)[where], dark_e[where]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    rendered, noise = kinds.add_parser("rendered"), kinds.add_parser("noise")
    rendered.add_argument("--scenes", type=int, default=30)
    rendered.add_argument("--seed", type=int, default=20000)
    noise.add_argument("--frames", type=int, default=100_000)
    noise.add_argument("--seed", type=int, default=1)
    height = kinds.add_parser("height")
    height.add_argument("--scenes", type=int, default=30)
    height.add_argument("--seed", type=int, default=20000)
    height.add_argument("--arc", choices=("on", "welding"), default="on")
    options = parser.parse_args()
    if options.kind == "noise":
        print_noise(options.frames, options.seed)
    elif options.kind == "height":
        print_heights(options.scenes, options.seed, options.arc)
    else:
        print_rendered(options.scenes, options.seed)


if __name__ == "__main__":
    main()
