"""What latency.py times steps on: frames of a moving torch, in a folder that any revision can read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from latency_worker import APPROACH, EXPOSURE_S, PERIOD_S, STRETCH, STRETCHES

from arctrack.nominal import nominal_setup
from arctrack.recording.setup_writer import format_setup
from arctrack.simulation.simulate import SimulatedMotion, SimulationPlan, balance
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup

METALS = {"v_groove": "mild_steel", "lap": "zn_coated", "corrugation": "zn_coated"}
HEIGHTS = {640: 480, 1280: 1024}

SPEED_MM_S = 10.0
"""The torch's travel. It weaves, rises and tilts as in `arctrack simulate`."""

WAY_MM, SPACING_MM, STRETCH_EVERY_MM = 60.0, 2.5, 15.0
"""The approach begins so far before the first stretch; a corrugation's pitch holds four of these."""

BOTH_ON = Condition(1.0, 1.0, EXPOSURE_S)


@dataclass(frozen=True)
class Case:
    """A joint at an image's width, and the folder with its setup, frames and poses."""

    joint: str
    width: int
    folder: Path

    @property
    def name(self) -> str:
        """Joint and width."""
        return f"{self.joint} {self.width}"

    @property
    def setup(self) -> Setup:
        """The setup that the tracker is given."""
        return balance(
            nominal_setup(self.joint, METALS[self.joint], width=self.width, height=HEIGHTS[self.width])
        )

    @property
    def track_target_ms(self) -> float:
        """What a step in track mode may take, ms, at the 99th percentile of its wall time."""
        return {640: 1.0, 1280: 2.0}[self.width] + (self.joint == "corrugation")

    @property
    def search_target_ms(self) -> float | None:
        """What the first step of a new tracker may take, ms."""
        return 6.0 if self.width == 1280 else None


def times_s() -> list[float]:
    """Return when each frame is taken, s: the approach, then the stretches, tick by tick."""
    approach = [(SPACING_MM * n - WAY_MM) / SPEED_MM_S for n in range(APPROACH)]
    begin = [STRETCH_EVERY_MM * n / SPEED_MM_S for n in range(STRETCHES)]
    return approach + [start_s + PERIOD_S * n for start_s in begin for n in range(STRETCH)]


def speckled(setup: Setup) -> Setup:
    """Return a setup whose laser speckles as its optics say; the tracker is not told."""
    return replace(setup, effects={**setup.effects, "laser_speckle": expected_speckle(setup)})


def draw_case(case: Case) -> Case:
    """Draw a case's frames along a seam that wanders, and write them with their poses and the setup."""
    setup, rng = case.setup, np.random.default_rng(0)
    drawn = speckled(setup)
    motion = SimulatedMotion(setup, SimulationPlan(travel_speed_mm_s=SPEED_MM_S), rng)
    poses = np.array([motion.T_base_tool(time_s) for time_s in times_s()])
    images = np.empty((len(poses), setup.camera.height, setup.camera.width), setup.sensor.dtype)
    for image, T_base_tool in zip(images, poses, strict=True):
        seam = motion.true_seam(*make_scene(setup, T_base_tool).stations_mm)
        image[:] = draw_frame(drawn, T_base_tool, BOTH_ON, rng, seam=seam)
    case.folder.mkdir()
    np.save(case.folder / "images.npy", images)
    np.save(case.folder / "poses.npy", poses)
    (case.folder / "recording.toml").write_text(format_setup(setup))
    return case
