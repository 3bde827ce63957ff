"""How long a step of the tracker takes, at two image sizes and three joints, and what of it takes how long.

    taskset -c 0 python benchmarks/latency.py [--repeats N] [--joint JOINT]

Simulated frames with laser and arc on, arc map included, after warm-up; OpenCV on one thread. Beside each the
floor, one pass over the frame (`cv2.sumElems`), and what others need for the stripe alone on the same frames.
Wall time is what a robot waits; CPU time leaves out what else the machine did meanwhile. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import cv2
import numpy as np
from stripe_peers import PEERS

import tracker.measure
import tracker.step
import tracker.stripe.read
from arctrack.nominal import nominal_setup
from arctrack.simulate import balance
from noise_model.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from noise_model.surface.joint import NOMINAL_SEAM
from tracker import flags
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.measure import Reading
from tracker.state import Frame, Pose
from tracker.step import TrackerState, step, step_and_reading
from tracker.stripe.read import Work
from tracker.stripe.scatter import NO_SCATTER

JOINTS = {"v_groove": "mild_steel", "lap": "zn_coated", "corrugation": "zn_coated"}
SIZES = (640, 480), (1280, 1024)
TRACK_TARGETS_MS, SEARCH_TARGET_MS = {640: 1.0, 1280: 2.0}, 6.0

FRAMES = 12
SEARCHES, PEER_RUNS, PASSES = 24, 5, 200
"""How often each of them is timed."""

STAGES = {
    "pose, scene, expected seam": ("pose_checks", "make_scene", "expected_seam"),
    "expected stripe": ("expect_stripe",),
    "arc: tables and level": ("arc_kernel", "arc_map_of", "unlit_by_the_laser", "estimate_arc_level"),
    "band: place and pixels": ("place", "gather", "weigh"),
    "band: arc map": ("_predict_background",),
    "matched filter and path": ("matched_filter", "best_path", "peaks"),
    "fits": ("fit_lines", "own_sigma"),
    "scatter": ("speckle_squared", "frame_scatter"),
    "a second stripe": ("second_place", "second_light"),
    "neighbours": ("smooth_stripe",),
    "reading, between these": ("read_stripe", "_fit_band"),
    "is it a stripe": ("leaves_image", "path_of", "evidence_ratio", "seen_share"),
    "triangulation": ("profile_of",),
    "joint": ("sources", "fit_joint", "is_another_type"),
    "seam and its history": ("_follow",),
    "offset": ("steer",),
}
"""What a step is made of: functions of `tracker.step`, `tracker.measure` and `tracker.stripe.read`."""

REST = "between the stages"


@dataclass
class Case:
    """A joint at an image size: its tables, frames and poses, and the state after them."""

    joint: str
    geometry: SensorGeometry
    frames: list[tuple[Frame, Pose]]
    work: Work
    state: TrackerState = field(default_factory=TrackerState)

    @classmethod
    def of(cls, joint: str, width: int, height: int) -> Case:
        """Draw the frames."""
        setup = balance(nominal_setup(joint, JOINTS[joint], width=width, height=height))
        rng = np.random.default_rng(0)
        frames = []
        for i in range(FRAMES):
            T_base_tool = np.eye(4)
            T_base_tool[:3, 3] = [2.0 * i, rng.uniform(-1.0, 1.0), rng.uniform(0.0, 1.0)]
            image = draw_frame(setup, T_base_tool, Condition(1.0, 1.0, 0.005), rng)
            frames.append((Frame(i, 0.1 * i, image, 0.005, 100.0), Pose(T_base_tool)))
        geometry = SensorGeometry.of(setup)
        return cls(joint, geometry, frames, Work.of(geometry))

    @property
    def name(self) -> str:
        """The joint and the image's width."""
        return f"{self.joint} {self.geometry.setup.camera.width}"

    def track(self, frame: Frame, pose: Pose) -> int:
        """Track a frame as the next one and return its flags."""
        self.state, track = step(self.geometry, self.state, frame, pose, self.work)
        return track.flags

    def search(self, frame: Frame, pose: Pose) -> Reading:
        """Track a frame as the first one of a new tracker."""
        reading = step_and_reading(self.geometry, TrackerState(), frame, pose, self.work)[2]
        assert reading is not None
        return reading

    def look(self, frame: Frame, pose: Pose) -> Reading:
        """Read a frame once as a search does, about the nominal seam."""
        return tracker.measure.measure(
            self.geometry, frame, pose, NOMINAL_SEAM, SEARCH_REACH_MM, self.work, True, NO_SCATTER
        )


def timed(run: Callable[..., Any], calls: list[tuple[Any, ...]]) -> tuple[Float64, Float64]:
    """Return wall and CPU time (n,) of calls, ms."""
    wall, cpu = np.empty((2, len(calls)))
    for n, arguments in enumerate(calls):
        wall_s, cpu_s = time.perf_counter(), time.thread_time()
        run(*arguments)
        cpu[n], wall[n] = time.thread_time() - cpu_s, time.perf_counter() - wall_s
    return 1e3 * wall, 1e3 * cpu


def one_pass_ms(image: np.ndarray) -> float:
    return float(np.median(timed(cv2.sumElems, PASSES * [(image,)])[0]))


class StageTimer:
    """Times functions of modules from outside, each without what it calls of the others."""

    def __init__(self) -> None:
        self.own_ms: dict[str, list[float]] = defaultdict(list)
        self._inner_s = [0.0]

    def watched(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that counts for a stage."""

        def watch(*arguments: Any, **named: Any) -> Any:
            self._inner_s.append(0.0)
            started = time.perf_counter()
            result = function(*arguments, **named)
            took = time.perf_counter() - started
            inner = self._inner_s.pop()
            self._inner_s[-1] += took
            self.own_ms[name][-1] += 1e3 * (took - inner)
            return result

        return watch

    def run(self, run: Callable[..., Any], calls: list[tuple[Any, ...]]) -> dict[str, float]:
        """Return the median ms of each stage in calls."""
        stages = {function: name for name, functions in STAGES.items() for function in functions}
        with ExitStack() as stack:
            for module in (tracker.step, tracker.measure, tracker.stripe.read):
                for function, name in stages.items():
                    if hasattr(module, function):
                        watched = self.watched(name, getattr(module, function))
                        stack.enter_context(mock.patch.object(module, function, watched))
            whole = self.watched(REST, run)
            for arguments in calls:
                for name in (*STAGES, REST):
                    self.own_ms[name].append(0.0)
                whole(*arguments)
        return {name: float(np.median(self.own_ms[name])) for name in (*STAGES, REST)}


def peak_kib(case: Case) -> float:
    """Return the most memory that a step holds beyond what it hands on, as Python and NumPy count it, KiB."""
    peaks = []
    tracemalloc.start()
    for frame, pose in case.frames:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        case.track(frame, pose)
        peaks.append(tracemalloc.get_traced_memory()[1] - before)
    tracemalloc.stop()
    return float(np.median(peaks)) / 1024.0


def print_steps(cases: list[Case], repeats: int) -> dict[str, float]:
    """Print the step's times in track mode; return the median of each case."""
    print("Track: a step whose seam is known, ms")
    print(
        f"{'':16} {'target':>6} {'p50':>6} {'p99':>6} {'max':>6}   {'CPU p50':>7} {'p99':>6} {'max':>6}"
        f"   {'one pass':>8} {'p50 over it':>11} {'searched':>8} {'KiB':>6}"
    )
    medians = {}
    for case in cases:
        calls = repeats * case.frames
        searched = np.mean([bool(case.track(*call) & flags.SEARCHED.mask) for call in case.frames])
        wall, cpu = timed(case.track, calls)
        floor = one_pass_ms(case.frames[0][0].image_dn)
        medians[case.name] = float(np.median(cpu))
        spread = [f"{value:6.2f}" for of in (wall, cpu) for value in (*np.percentile(of, [50, 99]), of.max())]
        target = TRACK_TARGETS_MS[case.geometry.setup.camera.width]
        print(
            f"{case.name:16} {target:6.1f} {' '.join(spread[:3])}   {spread[3]:>7} {' '.join(spread[4:])}"
            f"   {floor:8.3f} {np.median(wall) / floor:11.0f} {searched:8.2f} {peak_kib(case):6.0f}",
            flush=True,
        )
    return medians


def print_searches(cases: list[Case]) -> dict[str, float]:
    """Print the times of first steps and of one search look; return the median first step of each case."""
    print(
        f"\nSearch: the first step of a new tracker, and its first look alone; target {SEARCH_TARGET_MS} ms"
    )
    print(
        f"{'':16} {'p50':>6} {'p99':>6} {'CPU p50':>7}   {'look p50':>8} {'p99':>6} {'CPU p50':>7}"
        f" {'over one pass':>13}"
    )
    medians = {}
    for case in cases:
        calls = (SEARCHES // FRAMES) * case.frames
        timed(case.look, case.frames[:2])
        timed(case.search, case.frames[:2])
        (wall, cpu), (look, look_cpu) = timed(case.search, calls), timed(case.look, calls)
        medians[case.name] = float(np.median(cpu))
        floor = one_pass_ms(case.frames[0][0].image_dn)
        print(
            f"{case.name:16} {np.median(wall):6.2f} {np.percentile(wall, 99):6.2f} {np.median(cpu):7.2f}   "
            f"{np.median(look):8.2f} {np.percentile(look, 99):6.2f} {np.median(look_cpu):7.2f}"
            f" {np.median(look) / floor:13.0f}",
            flush=True,
        )
    return medians


def print_stages(cases: list[Case], repeats: int) -> None:
    """Print what a step in track mode and one search look are made of."""
    for title, kind in (("track", "track"), ("one search look", "look")):
        print(f"\nStages of a step, {title}, median ms")
        columns = []
        for case in cases:
            calls = (repeats if kind == "track" else SEARCHES // FRAMES) * case.frames
            columns.append(StageTimer().run(getattr(case, kind), calls))
        print(f"{'':28}" + " ".join(f"{case.name:>16}" for case in cases))
        for name in (*STAGES, REST):
            if any(column[name] for column in columns):
                print(f"{name:28}" + " ".join(f"{column[name]:16.3f}" for column in columns))
        print(f"{'sum':28}" + " ".join(f"{sum(column.values()):16.3f}" for column in columns))


def print_peers(cases: list[Case], track_ms: dict[str, float], search_ms: dict[str, float]) -> None:
    """Print what others take for the stripe alone, on whole frames and on the band that a step reads."""
    print("\nOthers, on the same frames: ms for the stripe alone, over ours for the whole step; CPU time")
    print(f"{'':16} {'':10} {'frame':>8} {'over search':>11} {'band':>8} {'over track':>10}")
    for case in cases:
        frame, pose = case.frames[0]
        case.state, _, reading = step_and_reading(case.geometry, case.state, frame, pose, case.work)
        assert reading is not None
        stripe = tracker.measure.expect_stripe(case.geometry, reading.scene)
        assert stripe is not None
        width_px = float(np.median(stripe.sigma_px))
        band = band_of(case, frame, pose)
        for name, peer in PEERS.items():
            took = []
            for image in (frame.image_dn, band):
                peer(image, width_px)
                took.append(float(np.median(timed(peer, PEER_RUNS * [(image, width_px)])[1])))
            print(
                f"{case.name:16} {name:10} {took[0]:8.1f} {took[0] / search_ms[case.name]:11.1f}"
                f" {took[1]:8.1f} {took[1] / track_ms[case.name]:10.1f}",
                flush=True,
            )


def band_of(case: Case, frame: Frame, pose: Pose) -> np.ndarray:
    """Return the pixels that a step in track mode reads, as an image along the stripe."""
    bands = []

    def keep(*arguments: Any) -> Any:
        look = read_stripe(*arguments)
        bands.append(np.ascontiguousarray(look.band.charge.T))
        return look

    read_stripe = tracker.measure.read_stripe
    with mock.patch.object(tracker.measure, "read_stripe", keep):
        case.track(frame, pose)
    return np.asarray(bands[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=40, help="how often the frames are tracked")
    parser.add_argument("--joint", choices=JOINTS, action="append", help="default: all of them")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    cases = [Case.of(joint, *size) for size in SIZES for joint in options.joint or JOINTS]
    for case in cases:
        for call in case.frames:
            case.track(*call)
    track_ms = print_steps(cases, options.repeats)
    search_ms = print_searches(cases)
    print_stages(cases, options.repeats)
    print_peers(cases, track_ms, search_ms)


if __name__ == "__main__":
    main()
