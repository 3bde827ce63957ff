"""An animation of a replay under a burning arc: the overlay's frames, small enough for a front page."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
from PIL import Image

from arctrack.nominal import nominal_setup
from arctrack.recording import read_recording
from arctrack.recording.results import OVERLAY_VIDEO
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording

FRAMES, FRAME_MS = 120, 250
"""Half a minute."""

WIDTH_PX, QUALITY = 480, 35
"""Width of the pictures, and WebP's quality, 0 to 100: 0.4 MB in all."""


def write_animation(path: Path) -> None:
    """Simulate a V-groove in mild steel whose arc burns, replay it, and write its overlay as a WebP."""
    with tempfile.TemporaryDirectory() as folder:
        plan = SimulationPlan(frames=FRAMES, production=True, seed=4)
        setup = balance(nominal_setup("v_groove", "mild_steel"))
        recorded = simulate_recording(Path(folder) / "recording", setup, plan)
        replay_recording(read_recording(recorded), Path(folder) / "results", ReplayOptions())
        first, *others = _frames(Path(folder) / "results" / OVERLAY_VIDEO)
    first.save(
        path, save_all=True, append_images=others, duration=FRAME_MS, loop=0, quality=QUALITY, method=4
    )


def _frames(video: Path) -> list[Image.Image]:
    read = cv2.VideoCapture(str(video))
    frames: list[Image.Image] = []
    while True:
        is_read, image = read.read()
        if not is_read:
            return frames
        height = round(image.shape[0] * WIDTH_PX / image.shape[1])
        small = cv2.resize(image, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        frames.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
