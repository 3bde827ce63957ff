"""The hand-eye calibration's expected error of the seam against the true one, before and after.

    python benchmarks/hand_eye.py [--seeds SEEDS] [--frames FRAMES]

For each joint and seed a recording is made as `arctrack simulate` makes it, the metals in turn. Its camera,
levels and noise are off by draws from the setup's tolerance; its arc's place and radius and its metal by some
from the calibration's priors. The camera's pose is found from the recording, which is then tracked with the
camera as stated and as found. Errors are RMS over valid frames against truth.csv, the constant part included,
in mm as lateral and vertical. χ² is ((lateral / expected)² + (vertical / expected)²) / 2; it is 1 on average
where the expected error is right.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.recording import BadFrame, read_recording, read_truth
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from calibration.hand_eye_arc import ARC_RADIUS_SIGMA, ARC_SIGMA_MM, REFLECTANCE_SIGMA, estimate_hand_eye
from noise_model.compiled.arrays import Float64
from noise_model.effects import Values
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from tracker.state import Frame, Pose
from tracker.tracker import Tracker


@dataclass(frozen=True)
class Outcome:
    """Expected and true errors (2,) of a recording as (lateral, vertical), mm, before and after."""

    expected_mm: tuple[Float64, Float64]
    true_mm: tuple[Float64, Float64]
    is_gain: bool

    def chi2(self, after: bool) -> float:
        """Return the mean square of true over expected error."""
        return float(np.mean((self.true_mm[after] / self.expected_mm[after]) ** 2))

    @property
    def change(self) -> float:
        """The true error after over that before, lateral and vertical together."""
        before, after = (float(np.hypot(*error_mm)) for error_mm in self.true_mm)
        return after / before


def hidden_effects(draw: np.random.Generator) -> dict[str, Values]:
    """Draw what arc and metal are off by from the priors of the calibration; the laser does not speckle."""
    x_mm, y_mm, z_mm = ARC_SIGMA_MM * draw.standard_normal(3)
    return {
        "laser_speckle": {"contrast": 0.0},
        "arc_deflection": {"x_mm": float(x_mm), "y_mm": float(y_mm)},
        "arc_length": {"height_mm": float(z_mm)},
        "arc_radius": {"radius_ratio": math.exp(ARC_RADIUS_SIGMA * draw.standard_normal())},
        "wrong_material": {"kappa_diff_ln": REFLECTANCE_SIGMA * draw.standard_normal()},
        "roughness_change": {"c2_ln": REFLECTANCE_SIGMA * draw.standard_normal()},
    }


def frames_of(path: Path) -> tuple[Setup, list[tuple[Frame, Pose]]]:
    recording = read_recording(path)
    buffer = recording.pose_buffer()
    read = [frame for frame in recording.frames() if not isinstance(frame, BadFrame)]
    posed = [(frame, recording.pose_at(buffer, frame.timestamp_s)) for frame in read]
    return recording.setup, [(frame, pose) for frame, pose in posed if pose is not None]


def true_error_mm(setup: Setup, frames: Sequence[tuple[Frame, Pose]], true: dict[int, Float64]) -> Float64:
    """Return the RMS (2,) of valid frames' errors as (lateral, vertical), mm."""
    tracker = Tracker(setup)
    tracks = [tracker.step(frame, pose) for frame, pose in frames]
    errors_mm = [np.subtract(track.seam_tool_mm, true[track.frame])[1:] for track in tracks if track.valid]
    return np.sqrt(np.mean(np.square(errors_mm), axis=0))


def judged(path: Path) -> Outcome:
    """Calibrate a recording and track it before and after; ValueError if the calibration refuses it."""
    setup, frames = frames_of(path)
    found = estimate_hand_eye(setup, frames)
    truth = read_truth(path)
    assert truth is not None
    true = {int(frame): point for frame, point in zip(truth.frames, truth.seam_tool_mm, strict=True)}
    after = replace(setup, camera=replace(setup.camera, T_tool_camera=found.T_tool_camera))
    return Outcome(
        (found.seam_sigma_before_mm, found.seam_sigma_after_mm),
        (true_error_mm(setup, frames, true), true_error_mm(after, frames, true)),
        found.is_gain,
    )


def print_summary(outcomes: Sequence[Outcome], refused: int) -> None:
    gains = [outcome for outcome in outcomes if outcome.is_gain]
    print(
        f"\n{len(outcomes) + refused} recordings: {len(gains)} calibrated, "
        f"{len(outcomes) - len(gains)} without a clear gain, {refused} refused for another reason"
    )
    for name, chosen in (("calibrated", gains), ("all that have a result", outcomes)):
        if not chosen:
            continue
        better = sum(outcome.change < 1.0 for outcome in chosen)
        print(f"{name}: the seam's error shrank in {better} of {len(chosen)}")
        for after, when in ((False, "before"), (True, "after")):
            expected, true = (
                np.sqrt(np.mean([np.square(kind[after]) for kind in kinds], axis=0))
                for kinds in zip(*((o.expected_mm, o.true_mm) for o in chosen), strict=True)
            )
            chi2 = np.mean([outcome.chi2(after) for outcome in chosen])
            print(
                f"  {when:6} expected {expected[0]:.3f} {expected[1]:.3f}, true {true[0]:.3f} {true[1]:.3f}, "
                f"χ² {chi2:.2f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=SimulationPlan.frames)
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'':26} {'expected before':>15} {'after':>13} {'true before':>15} {'after':>13} {'ratio':>6}")
    outcomes: list[Outcome] = []
    refused = 0
    with tempfile.TemporaryDirectory() as folder:
        for n, joint in enumerate(DIMENSIONS):
            for seed in range(chosen.seeds):
                metal = list(TABLE_1)[(n + seed) % len(TABLE_1)]
                name = f"{joint} {metal} {seed}"
                effects = hidden_effects(np.random.default_rng([n, seed]))
                plan = SimulationPlan(frames=chosen.frames, seed=1000 * n + seed)
                setup = balance(nominal_setup(joint, metal))
                path = simulate_recording(Path(folder) / name.replace(" ", "_"), setup, plan, None, effects)
                try:
                    outcome = judged(path)
                except ValueError as error:
                    refused += 1
                    print(f"{name:26} refused: {error}", flush=True)
                    continue
                outcomes.append(outcome)
                pairs = (*outcome.expected_mm, *outcome.true_mm)
                text = "  ".join(f"{lateral:6.3f} {vertical:6.3f}" for lateral, vertical in pairs)
                note = "" if outcome.is_gain else "  no clear gain"
                print(f"{name:26}  {text} {outcome.change:6.2f}{note}", flush=True)
    print_summary(outcomes, refused)


if __name__ == "__main__":
    main()
