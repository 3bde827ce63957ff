"""The stripe on a flat plate in the frames of recordings, each at another pose of the robot."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.errors import in_file
from arctrack.recording import BadFrame, Recording
from calibration.camera.known_lens import lens_from_camera
from calibration.camera.lens import Lens
from calibration.gauge.adjustment import Sighting
from calibration.gauge.plate import plate_sighting
from calibration.gauge.stripe_pieces import laser_light_alone
from calibration.laser.stripe import REACH, BoardStripe, find_stripe
from noise_model.compiled.arrays import Float64, Integers
from noise_model.even_sample import evenly
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup

MAX_FRAMES = 40
"""Number of frames that are used, evenly spread over all poses."""

STILL_MM, STILL_DEG = 0.5, 0.05
"""A robot that has moved and turned by less stands still: its error is that of the frame before."""

MAX_SATURATED = 0.5
"""Share of saturated pixels about a stripe from which on its sides are not seen."""


@dataclass
class PlateFrames:
    """Stripes on a plate: `stripes` (n,) in `images` (n,), as `sightings` (n,).

    `left_out` maps unused frames to the reason, `poses` is the number of poses of the robot that were looked
    at.
    """

    lens: Lens
    poses: int = 0
    sightings: list[Sighting] = field(default_factory=list)
    stripes: list[BoardStripe] = field(default_factory=list)
    images: list[Integers] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    bad_frames: list[BadFrame] = field(default_factory=list)


def read_plate_frames(
    recordings: Sequence[Recording], setup: Setup, progress: Callable[[int, int], None]
) -> PlateFrames:
    """Find the stripe in frames of the laser alone.

    ArctrackError where there are none, or none has a pose.
    """
    frames = PlateFrames(lens_from_camera(setup.camera))
    chosen = [(recording, _at_other_poses(recording)) for recording in recordings]
    frames.poses = sum(len(rows) for _, rows in chosen)
    used = {*evenly(frames.poses, MAX_FRAMES).tolist()}
    first = done = 0
    for recording, rows in chosen:
        kept = [row for n, row in enumerate(rows, start=first) if n in used]
        first += len(rows)
        for row, frame in zip(kept, recording.frames([*kept]), strict=True):
            progress(done, len(used))
            done += 1
            if isinstance(frame, BadFrame):
                frames.bad_frames.append(frame)
                continue
            _add(frames, f"{recording.name}: frame {frame.index}", frame.image_dn, rows[row], setup)
    progress(len(used), len(used))
    return frames


def _at_other_poses(recording: Recording) -> dict[int, Float64]:
    """Return the rows that show the laser alone, each at another pose (4, 4) of the tool, mm."""
    lit = [n for n, row in enumerate(recording.rows) if row.laser_on and not row.arc_on]
    if not lit:
        raise in_file(recording.path, "has no frame of the laser alone: take them with the arc off")
    poses = recording.poses_at(recording.rows[n].timestamp_s for n in lit)
    moved: dict[int, Float64] = {}
    last = np.full((4, 4), np.inf)
    for n, pose in zip(lit, poses, strict=True):
        if pose is None:
            continue
        T = pose.T_base_tool
        if moved and np.linalg.norm(T[:3, 3] - last[:3, 3]) < STILL_MM:
            turn = Rotation.from_matrix(T[:3, :3].T @ last[:3, :3]).magnitude()
            if np.degrees(turn) < STILL_DEG:
                continue
        moved[n] = last = T
    if not moved:
        raise in_file(recording.path, "the robot's pose is known at no frame of the laser alone: poses.csv")
    return moved


def _add(frames: PlateFrames, name: str, image: Integers, T_base_tool: Float64, setup: Setup) -> None:
    """Look for the stripe in a frame (H, W)."""
    stripe = find_stripe(laser_light_alone(image))
    if _saturated_share(image, stripe, saturation_dn(setup.sensor)) > MAX_SATURATED:
        frames.left_out[name] = "its stripe is saturated: shorten the exposure, or dim the laser"
    elif stripe is None:
        frames.left_out[name] = "shows no straight stripe"
    else:
        rays = frames.lens.rays(stripe.points_px)
        frames.sightings.append(plate_sighting(name, T_base_tool, rays, stripe.along_rows))
        frames.stripes.append(stripe)
        frames.images.append(image)


def _saturated_share(image: Integers, stripe: BoardStripe | None, limit_dn: int) -> float:
    """Return the share of saturated pixels about a stripe, or without one in the whole image."""
    if stripe is None:
        return float(np.mean(image >= limit_dn))
    half = int(np.ceil(REACH * stripe.scale_px))
    lines = image.T if stripe.along_rows else image
    scan, place = stripe.points_px.round().astype(np.int64).T[:: 1 if stripe.along_rows else -1]
    about = (place[:, np.newaxis] + np.arange(-half, half + 1)).clip(0, lines.shape[1] - 1)
    return float(np.mean(lines[scan[:, np.newaxis], about] >= limit_dn))
