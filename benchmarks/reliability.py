"""Confidence against what happened: how often the seam lies within its tolerance where it is said to.

    python benchmarks/reliability.py [--trials N] [--plot PICTURE]

Each trial is another installation: a joint, a stated hand-eye tolerance, a weld's tolerance and a stripe's
level are drawn, and then by how much camera, arc, laser and black level are off what the setup states. A
frame of a seam beside its path is drawn with noise, searched and tracked. What is compared is
`Track.confidence`, in bins, with the share of valid frames whose lateral and vertical error both lie within
`[tolerance] seam_mm`.
"""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from seam_truth import seam_in_tool

from arctrack.nominal import nominal_setup
from arctrack.report import style
from arctrack.simulation.simulate import balance, true_values
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.instrument.sensor import expose
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import transform
from tracker.state import Frame, Pose, Track
from tracker.tracker import Tracker

JOINTS = ("v_groove", "half_v", "fillet", "lap")
WIDTH, HEIGHT = 320, 240

HAND_EYE = (0.2, 4.0)
"""From how little to how much of the nominal hand-eye tolerance a setup states, evenly in its logarithm."""

SEAM_MM = (0.1, 0.6)
STRIPE_E = (800.0, 5000.0)
EDGES = np.linspace(0.0, 1.0, 11)


@dataclass(frozen=True)
class Trial:
    """What one frame's track said and what was true; `within` says whether both errors stay in tolerance."""

    track: Track
    error_mm: tuple[float, float]
    within: bool


def trial(rng: np.random.Generator, base: dict[str, Setup]) -> Trial:
    """Draw an installation, what it is off by, and a frame; track it."""
    stated = base[JOINTS[rng.integers(len(JOINTS))]]
    of_hand_eye = math.exp(rng.uniform(*np.log(HAND_EYE)))
    tolerance = replace(
        stated.tolerance,
        hand_eye_deg=of_hand_eye * stated.tolerance.hand_eye_deg,
        hand_eye_mm=of_hand_eye * stated.tolerance.hand_eye_mm,
        seam_mm=math.exp(rng.uniform(*np.log(SEAM_MM))),
    )
    dimming = math.exp(rng.uniform(*np.log(STRIPE_E))) / stated.laser.peak_e
    stated = replace(
        stated,
        tolerance=tolerance,
        laser=replace(stated.laser, peak_e=dimming * stated.laser.peak_e),
        arc=replace(stated.arc, radiance_e=dimming * stated.arc.radiance_e),
    )
    true = true_values(stated, rng)
    condition = Condition(laser_level=1.0, arc_level=1.0, exposure_s=stated.camera.exposure_s)
    T_base_tool = np.eye(4)
    seam = SeamLine(0.0, *rng.uniform(-1.5, 1.5, 2))
    mean_e = predict(true, T_base_tool, condition, seam=seam).mean_e
    frame = Frame(0, 0.0, expose(mean_e, true.sensor, rng), stated.camera.exposure_s, stated.arc.current_a)
    track = Tracker(stated).step(frame, Pose(T_base_tool))
    scene = make_scene(true, T_base_tool, seam)
    point = seam_in_tool(true, scene)
    there, here = (transform(scene.T_joint_tool, np.asarray(p)) for p in (track.seam_tool_mm, point))
    error = float(there[1] - here[1]), float(there[2] - here[2])
    return Trial(track, error, max(map(abs, error)) <= tolerance.seam_mm)


def reliability(trials: list[Trial]) -> list[tuple[float, float, float, int]]:
    """Return for each bin the mean confidence, the share within tolerance, its 1 sigma and the frames."""
    said = np.array([one.track.confidence for one in trials])
    within = np.array([one.within for one in trials])
    rows = []
    for low, high in itertools.pairwise(EDGES):
        chosen = (said >= low) & ((said < high) | (high == 1.0))
        n = int(chosen.sum())
        if n:
            p = float(said[chosen].mean())
            rows.append((p, float(within[chosen].mean()), math.sqrt(p * (1.0 - p) / n), n))
    return rows


def plot(rows: list[tuple[float, float, float, int]], path: str) -> None:
    figure = style.new_figure(6.4, 5.0, "Confidence against what happened")
    axes = style.plain(
        figure.add_subplot(),
        "stated confidence, mean of its bin",
        "share of frames within [tolerance] seam_mm",
    )
    said, happened, sigma, n = np.array(rows).T
    axes.plot([0, 1], [0, 1], color=style.GREY, linewidth=1.0, label="as stated")
    axes.errorbar(
        said, happened, sigma, fmt="o", color=style.BLUE, capsize=3, label="frames tracked, chance's 1 sigma"
    )
    for x, y, count in zip(said, happened, n, strict=True):
        axes.annotate(f"{int(count)}", (x, y), xytext=(7, -11), textcoords="offset points", fontsize=8)
    axes.set_xlim(0.0, 1.02)
    axes.set_ylim(0.0, 1.02)
    axes.legend(frameon=False, loc="upper left")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=3000)
    parser.add_argument("--plot", metavar="PICTURE")
    options = parser.parse_args()
    base = {
        joint: balance(nominal_setup(joint, "mild_steel", width=WIDTH, height=HEIGHT)) for joint in JOINTS
    }
    rng = np.random.default_rng(0)
    every = [trial(rng, base) for _ in range(options.trials)]
    trials = [one for one in every if one.track.valid]
    rows = reliability(trials)
    print(f"{len(trials)} of {len(every)} frames valid")
    print(f"{'confidence':>10} {'within':>7} {'1 sigma':>7} {'frames':>6}")
    for said, happened, sigma, n in rows:
        print(f"{said:10.3f} {happened:7.3f} {sigma:7.3f} {n:6d}")
    pull = np.array([np.divide(t.error_mm, (t.track.sigma_y_mm, t.track.sigma_z_mm)) for t in trials])
    print("chi2 of the stated sigmas, lateral and vertical: {:.2f} {:.2f}".format(*np.mean(pull**2, axis=0)))
    if options.plot:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
