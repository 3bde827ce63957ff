"""The tracker anywhere: joints, views, metals, lasers, sensors at random, in a world that is not the model.

    python benchmarks/anywhere.py [--draws 60] [--frames 6] [--seed 1] [--joint NAME] [--workers 2]
                                  [--arc drawn|on|welding] [--path drawn|turning|circle|corner]
                                  [--bounds] [--pictures FOLDER]

Each draw states a setup with the true camera and dimensions. What it does not state: where the seam runs,
speckle, the frame's noise, light of the hall, ghosts, glints, and half of the fans that end in the image. A
scene's name says what it has of these. Some draws are plates without the joint that the setup states.

The arc burns in two scenes of five. `--arc on` has it burn in all, `--arc welding` adds to the same scenes
streaks of spatter, glare along the seam and the stripe mirrored between the faces (`swept_welding.py`).

One seam of five turns, on a circle or round the corner of a box, the tool with it (`--path turning`: all
that have no ridges).

Told by joint, view and path: how many frames are valid, errors across (y) and along the normal (z), error
over sigma, and valid frames that are wrong beyond 5 sigma and 0.25 mm. `--bounds` holds each scene's RMS
against what its middle frame can show (`scene_bound.py`), which takes some seconds a scene. `--pictures`
draws the ten worst frames.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import count, islice, repeat
from pathlib import Path

import cv2
import numpy as np
from scene_bound import SeamBound, seam_bound

from noise_model.compiled.arrays import Float64
from tracker.tracker import Tracker
from validation.anywhere.random_scene import ARCS, JOINTS, PATHS, draw_scene, frames_of, joint_of

FALSE_SIGMAS, FALSE_MM = 5.0, 0.25
RIGHT_MM, OVER_BOUND, TELLING_MM = 0.03, 1.3, 0.1
"""A scene's RMS is right at so many mm, or times its bound. The last bounds a seam that is shown well."""

WORST, SIGMA_FLOOR_MM = 10, 0.02
"""So many frames are told as the worst, by their error over sigma, which counts as this at least."""


@dataclass(frozen=True)
class Outcome:
    """One frame's track beside the truth; NaN where there is no seam."""

    seed: int
    scene: str
    joint: str
    view: str
    path: str
    frame: int
    valid: bool
    error_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    flags: str

    @property
    def is_false(self) -> bool:
        """Whether the frame is valid and wrong."""
        if not self.valid:
            return False
        if self.joint == "plate":
            return True
        pairs = zip(self.error_mm, self.sigma_mm, strict=True)
        return any(abs(e) > FALSE_MM and abs(e) > FALSE_SIGMAS * s for e, s in pairs)


def run(seed: int, n_frames: int, arc: str, path: str) -> list[Outcome]:
    """Track one scene; return its frames' outcomes."""
    scene = draw_scene(seed, n_frames, arc, path)
    try:
        tracker = Tracker(scene.setup)
    except ValueError as error:
        print(f"{scene.name}: no setup: {error}", flush=True)
        return []
    outcomes = []
    for frame, pose, truth in frames_of(scene):
        track = tracker.step(frame, pose)
        error_y, error_z = np.subtract(track.seam_tool_mm, truth)[1:].tolist()
        sigma = track.sigma_y_mm, track.sigma_z_mm
        place = seed, scene.name, scene.joint, scene.view, scene.path, frame.index
        outcomes.append(Outcome(*place, track.valid, (error_y, error_z), sigma, ",".join(track.flag_names)))
    return outcomes


def bound_of(seed: int, n_frames: int, arc: str, path: str) -> SeamBound | None:
    """Return how well the middle frame of a scene shows its seam; None of a plate."""
    scene = draw_scene(seed, n_frames, arc, path)
    return None if scene.joint == "plate" else seam_bound(scene, n_frames // 2)


def bounds_table(outcomes: list[Outcome], bounds: dict[int, SeamBound]) -> None:
    """Print how scenes' RMS lie beside what their frames can show, a line a joint."""
    groups: dict[str, list[tuple[float, Float64, Float64]]] = defaultdict(list)
    for seed, bound in bounds.items():
        tracked = [o for o in outcomes if o.seed == seed]
        if not tracked:
            continue
        error, _ = _errors([o for o in tracked if o.valid])
        rms_mm = np.sqrt(np.mean(error**2, axis=0)) if len(error) else np.full(2, math.nan)
        limits = np.array([np.maximum(OVER_BOUND * np.array(sigma), RIGHT_MM) for sigma in bound])
        valid = len(error) / len(tracked) if bound.least_squares_mm.max() < TELLING_MM else math.nan
        groups[tracked[0].joint].append((valid, rms_mm, limits))
    print("\nRMS within the larger of 0.03 mm and 1.3 times what the frame can show, share of the scenes")
    print("joint        scenes  bound y    z  least squares y    z  valid where these show it to 0.1 mm")
    for name, scenes in groups.items():
        rms_mm = np.array([scene[1] for scene in scenes])
        right = rms_mm[:, None] <= np.array([scene[2] for scene in scenes])
        known = np.isfinite(rms_mm).all(axis=1)
        valid = np.array([scene[0] for scene in scenes])
        shares = 100 * right[known].mean(axis=0) if known.any() else np.full((2, 2), math.nan)
        share = 100 * float(np.nanmean(valid)) if np.isfinite(valid).any() else math.nan
        print(
            f"{name:12} {len(scenes):6} {shares[0, 0]:7.0f}% {shares[0, 1]:3.0f}% "
            f"{shares[1, 0]:14.0f}% {shares[1, 1]:3.0f}% {share:6.0f}%"
        )


def draw_picture(outcome: Outcome, given: tuple[int, str, str], folder: Path) -> None:
    """Draw the frame of an outcome into a folder; the scene is made again."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame, _, _ in frames_of(draw_scene(outcome.seed, *given)):
        if frame.index == outcome.frame:
            name = f"{outcome.scene.replace(' ', '_')}_{frame.index}.png"
            cv2.imwrite(str(folder / name), frame.image_dn)
            return


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def table(outcomes: list[Outcome], by: str) -> None:
    """Print what was seen, a line a group."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[str(getattr(outcome, by))].append(outcome)
    print(f"\n{by:12} frames  valid   RMS y   RMS z  99 % |y|  e/s y  e/s z  false")
    for name, group in groups.items():
        used = [o for o in group if o.valid]
        error, pulls = _errors(used)
        worst = float(np.quantile(np.abs(error[:, 0]), 0.99)) if len(used) else math.nan
        share, wrong = 100 * len(used) / len(group), sum(o.is_false for o in group)
        print(
            f"{name:12} {len(group):6} {share:5.0f}% {_rms(error[:, 0]):7.3f} {_rms(error[:, 1]):7.3f} "
            f"{worst:9.3f} {_rms(pulls[:, 0]):6.2f} {_rms(pulls[:, 1]):6.2f} {wrong:6}"
        )


def _errors(used: list[Outcome]) -> tuple[Float64, Float64]:
    """Return errors (n, 2), mm, and errors over sigma (n, 2) of outcomes."""
    error = np.array([o.error_mm for o in used]).reshape(-1, 2)
    return error, error / np.array([o.sigma_mm for o in used]).reshape(-1, 2)


def say(number: int, outcomes: list[Outcome]) -> None:
    """Print one scene."""
    used = [o for o in outcomes if o.valid]
    error, pulls = _errors(used)
    why = sorted({o.flags for o in outcomes if not o.valid})[:2]
    print(
        f"{number:4} {outcomes[0].scene:60} {len(used)}/{len(outcomes)} "
        f"rms {_rms(error[:, 0]):.3f} {_rms(error[:, 1]):.3f} e/s {_rms(pulls[:, 0]):.2f} "
        f"{_rms(pulls[:, 1]):.2f} {'FALSE ' if any(o.is_false for o in outcomes) else ''}{why}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=60, help="scenes that are drawn")
    parser.add_argument("--frames", type=int, default=6, help="frames of each")
    parser.add_argument("--seed", type=int, default=1, help="of the first scene; the others follow")
    parser.add_argument(
        "--joint",
        choices=JOINTS,
        help="draw this joint alone, at its own seeds from --seed on",
    )
    parser.add_argument("--arc", choices=ARCS, default="drawn", help="where the arc burns, and what it adds")
    parser.add_argument("--path", choices=PATHS, default="drawn", help="which seams turn")
    parser.add_argument("--workers", type=int, default=1, help="processes at once")
    parser.add_argument("--bounds", action="store_true", help="hold RMS against what frames can show")
    parser.add_argument("--pictures", type=Path, help="draw the worst frames into this folder")
    parser.add_argument("--verbose", action="store_true", help="print every scene")
    options = parser.parse_args()
    drawn = (s for s in count(options.seed) if options.joint in (None, joint_of(s)))
    seeds = list(islice(drawn, options.draws))
    given = options.frames, options.arc, options.path
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(options.workers) as pool:
        for done, tracked in enumerate(pool.map(run, seeds, *map(repeat, given)), 1):
            outcomes += tracked
            if options.verbose and tracked:
                say(done, tracked)
            elif not options.verbose:
                print(f"{done} of {len(seeds)} scenes", end="\r", flush=True)
    told = [o for o in outcomes if o.joint != "plate"]
    table(told, "joint")
    table(told, "view")
    table(told, "path")
    table([o for o in outcomes if o.joint == "plate"], "joint")
    if options.bounds:
        with ProcessPoolExecutor(options.workers) as pool:
            found = pool.map(bound_of, seeds, *map(repeat, given))
            bounds = {seed: bound for seed, bound in zip(seeds, found, strict=True) if bound is not None}
        bounds_table(outcomes, bounds)
    false = [o for o in outcomes if o.is_false]
    print(f"\nfalse valids: {len(false)} of {len(outcomes)} frames")
    ranked = sorted(
        (o for o in outcomes if o.valid),
        key=lambda o: (
            -max(abs(e) / max(s, SIGMA_FLOOR_MM) for e, s in zip(o.error_mm, o.sigma_mm, strict=True))
        ),
    )[:WORST]
    for o in ranked:
        print(
            f"worst: {o.scene} frame {o.frame}: error y {o.error_mm[0]:+.3f} ({o.sigma_mm[0]:.3f}), "
            f"z {o.error_mm[1]:+.3f} ({o.sigma_mm[1]:.3f}) mm {o.flags}"
        )
        if options.pictures:
            draw_picture(o, given, options.pictures)


if __name__ == "__main__":
    main()
