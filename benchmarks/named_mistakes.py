"""How often `arctrack check` names the mistake that a setup has: seven kinds, each drawn some times.

    python benchmarks/named_mistakes.py --draws 40

Sound recordings are simulated with true values that differ from the nominal ones by the tolerance, the tool
tilted by 5 degrees and lifted by 6 mm. Each draw puts one mistake into a setup, and looks at five frames.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from arctrack.check.check_sample import CheckCase, case_of, chosen_rows
from arctrack.check.explanations import explanations
from arctrack.check.hint import Hint, hint_of
from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.recording import read_recording
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from calibration.check.stripe_place import with_changes
from noise_model.even_sample import evenly
from noise_model.setup import Setup

RECORDINGS, FRAMES = 8, 5
OUTCOMES = ("named first", "among those named", "nothing named", "another named alone")

Spoil = Callable[[Setup, np.random.Generator], Setup]


def off_by(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number between two bounds, of either sign."""
    return float(rng.uniform(low, high) * rng.choice([-1.0, 1.0]))


def stale_sheet(setup: Setup, rng: np.random.Generator) -> Setup:
    return with_changes(setup, {"laser_offset": off_by(rng, 1.5, 5.0), "laser_rot_2": rng.normal(0.0, 0.5)})


def wrong_hand_eye(setup: Setup, rng: np.random.Generator) -> Setup:
    turns = {f"camera_rot_{axis}": off_by(rng, 0.7, 2.0) for axis in "xyz"}
    return with_changes(setup, turns | {f"camera_{axis}": rng.normal(0.0, 4.0) for axis in "xyz"})


def wrong_lens(setup: Setup, rng: np.random.Generator) -> Setup:
    return with_changes(setup, {"ln_focal": off_by(rng, 0.1, 0.7)})


def wrong_width(setup: Setup, rng: np.random.Generator) -> Setup:
    ratio = float(np.exp(off_by(rng, 0.7, 1.8)))
    return replace(setup, laser=replace(setup.laser, stripe_sigma_mm=ratio * setup.laser.stripe_sigma_mm))


def wrong_scale(setup: Setup, rng: np.random.Generator) -> Setup:
    camera, laser = setup.camera, setup.laser
    if rng.random() < 0.5:
        T_tool_camera = camera.T_tool_camera.copy()
        T_tool_camera[:3, 3] *= 1e-3
        return replace(setup, camera=replace(camera, T_tool_camera=T_tool_camera))
    n_x, n_y, n_z, d = laser.plane_in_tool
    return replace(setup, laser=replace(laser, plane_in_tool=(n_x, n_y, n_z, 1e-3 * d)))


def wrong_type(setup: Setup, rng: np.random.Generator) -> Setup:
    others = [name for name in ("butt", "lap", "fillet", "corrugation") if name != setup.joint.type]
    name = str(rng.choice(others))
    return replace(setup, joint=replace(setup.joint, type=name, dimensions=DIMENSIONS[name]))


def wrong_dimension(setup: Setup, rng: np.random.Generator) -> Setup:
    return with_changes(setup, {f"ln_{next(iter(setup.joint.dimensions))}": off_by(rng, 0.3, 0.6)})


KINDS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "stale sheet": (stale_sheet, ("[laser] plane_in_tool is",)),
    "hand-eye": (wrong_hand_eye, ("[camera.pose_in_tool] is", "[camera.pose_in_tool] and")),
    "lens": (wrong_lens, ("[camera] fx, fy",)),
    "width": (wrong_width, ("[laser] stripe_sigma_mm",)),
    "scale": (
        wrong_scale,
        ("[camera.pose_in_tool] is in m", "[laser] plane_in_tool: its last number is in m"),
    ),
    "joint's type": (wrong_type, ("[joint] type",)),
    "joint's dimension": (wrong_dimension, tuple(f"[joint] {next(iter(d))}" for d in DIMENSIONS.values())),
}
"""Each kind of mistake, and how the hint that names it begins.

The dimension is the joint's first, as a V-groove's angle.
"""


def sound_cases(folder: Path, joint: str, width: int) -> list[CheckCase]:
    """Return cases of sound recordings of a joint."""
    setup = balance(nominal_setup(joint, "mild_steel", width=width, height=3 * width // 4))
    setup = replace(setup, arc=replace(setup.arc, radiance_e=0.3 * setup.arc.radiance_e))
    cases = []
    for seed in range(RECORDINGS):
        plan = SimulationPlan(frames=16, rate_hz=5.0, tilt_deg=5.0, height_mm=(0.1, 6.0), seed=seed)
        recording = read_recording(simulate_recording(folder / str(seed), setup, plan))
        rows = chosen_rows(recording)
        positions = [rows[n] for n in evenly(len(rows), FRAMES)]
        case = case_of(recording, positions)
        assert case is not None
        cases.append(case)
    return cases


def outcome(hint: Hint | None, starts: tuple[str, ...]) -> str:
    """Return what the hint of a check comes to, given how the right answer begins."""
    if hint is None:
        return OUTCOMES[2]
    what = hint.what.rpartition("off its place: ")[2]
    if what.startswith(starts):
        return OUTCOMES[0]
    return OUTCOMES[1] if any(f"or else {start}" in hint.cure for start in starts) else OUTCOMES[3]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40, help="draws of each kind")
    parser.add_argument("--kind", action="append", choices=list(KINDS), help="default: all of them")
    parser.add_argument("--seed", type=int, default=7, help="seed of the draws")
    parser.add_argument("--joint", default="v_groove", choices=list(DIMENSIONS))
    parser.add_argument("--width", type=int, default=160, help="of the images, px; their height is 3/4 of it")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        cases = sound_cases(Path(folder), options.joint, options.width)
    print(f"| mistake | draws | {' | '.join(OUTCOMES)} |\n| --- | {'--- | ' * (1 + len(OUTCOMES))}".rstrip())
    for kind in options.kind or KINDS:
        spoil, starts = KINDS[kind]
        rng, counts = np.random.default_rng(options.seed), Counter[str]()
        for n in range(options.draws):
            case = cases[n % len(cases)]
            hint = hint_of(explanations(case.with_setup(spoil(case.setup, rng))))
            counts[outcome(hint, starts)] += 1
        print(
            f"| {kind} | {options.draws} | {' | '.join(str(counts[name]) for name in OUTCOMES)} |", flush=True
        )


if __name__ == "__main__":
    main()
