"""The benchmark's scenes: `anywhere`'s draws as recordings that anyone reads, each with its truth."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import arctrack
from arctrack.errors import in_file
from arctrack.recording.reader import read_truth
from arctrack.recording.writer import RecordingWriter
from noise_model.compiled.arrays import Float64, Integers
from noise_model.setup import Setup
from noise_model.stripe import stripe_runs_along_rows
from noise_model.transforms import invert, transform
from tracker.state import Frame, Pose
from validation.anywhere.random_scene import RandomScene, draw_scene, frames_of, world_of
from validation.anywhere.swept_joint import first_hits
from validation.anywhere.swept_world import SweptWorld

FRAMES = 3
"""Frames of a scene."""

FIRST_SEED = {"plain": 700_001, "welding": 710_001, "learn": 720_001, "tune": 730_001}
COUNT = {"plain": 300, "welding": 60, "learn": 200, "tune": 20}
"""Seeds of the sets, one after another: two that judge, that of a network, that of settings."""

JUDGED = ("plain", "welding")
KEPT = {"plain": 12, "welding": 4}
"""So many scenes of each set are in the repository: its first."""

HERE = Path(__file__).parent / "kept"
"""Where those are."""

NEAR_SIGMAS, CENTRING_STEPS = 3.0, 3
"""The stripe's light counts within so many sigmas of its centre, which is looked for so many times."""

MARGIN_S = 0.05
"""Poses reach so far beyond the frames: one between two poses alone is known."""

TRUTH_STRIPE = "truth_stripe.csv"

MIN_LIGHT_SIGMAS = 1.0
"""A line shows a stripe where its light, without noise, is so many sigmas of its pixel's noise."""


@dataclass(frozen=True)
class TruthFrame:
    """A frame, its pose and what is true of it.

    `stripe_px` (n,) is the centre of the stripe's light in each scan line, px, NaN where it shows none;
    `seam_mm` (3,) the seam in the tool frame, NaN where there is no joint, `seam_px` (2,) its pixel.
    """

    frame: Frame
    pose: Pose
    stripe_px: Float64
    seam_mm: Float64
    seam_px: Float64


@dataclass(frozen=True)
class BenchScene:
    """A scene: its name, its set, what is stated, and its frames."""

    name: str
    kind: str
    setup: Setup
    frames: tuple[TruthFrame, ...]

    @property
    def width_px(self) -> float:
        """The stripe's sigma, px, by the setup."""
        return width_px(self.setup)

    @property
    def along_rows(self) -> bool:
        """Whether the stripe runs along the image's rows: its scan lines are the columns then."""
        return stripe_runs_along_rows(self.setup)

    def upright(self, frame: Frame) -> Integers:
        """Return a frame's image with the stripe from left to right: a scan line is a column."""
        image = frame.image_dn
        return image if self.along_rows else np.ascontiguousarray(image.T)


def width_px(setup: Setup) -> float:
    """Return the stripe's sigma, px, where the sheet meets a plate at tool height."""
    camera, laser = setup.camera, setup.laser
    away_mm = float(np.linalg.norm(camera.T_tool_camera[:3, 3] - laser.point_mm))
    return float(max(laser.stripe_sigma_mm * camera.fx / away_mm, camera.psf_sigma_px))


def seeds_of(kind: str, count: int | None = None) -> range:
    """Return a set's seeds, or its first ones."""
    first = FIRST_SEED[kind]
    return range(first, first + (COUNT[kind] if count is None else count))


def drawn(kind: str, seed: int) -> BenchScene:
    """Draw a scene of a set; equal seeds give equal scenes. A network's have one frame each."""
    is_welding = kind == "welding" or (kind in ("learn", "tune") and seed % 2 == 0)
    scene = draw_scene(seed, 1 if kind == "learn" else FRAMES, "welding" if is_welding else "drawn")
    world, frames = world_of(scene), []
    for frame, pose, seam in frames_of(scene):
        stripe_px = stripe_truth(world, scene, pose.T_base_tool, width_px(scene.setup))
        seam = np.full(3, math.nan) if scene.joint == "plate" else seam
        frames.append(TruthFrame(frame, pose, stripe_px, seam, _pixel(scene.setup, seam)))
    return BenchScene(f"{kind}_{seed}", kind, scene.setup, tuple(frames))


def stripe_truth(world: SweptWorld, scene: RandomScene, T_base_tool: Float64, width_px: float) -> Float64:
    """Return the centre of the stripe's light, without noise, in each scan line (n,), px; NaN for none.

    Rays of a line's pixels meet the metal at a distance from the sheet, mm, whose sign changes in its middle.
    About that, of several the brightest one, it is the centroid: where the metal curves, its light is not
    even about the sheet's middle, and no reader of an image can know of that.
    """
    setup = world.setup
    shape = setup.camera.height, setup.camera.width
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    xy = setup.camera.normalised(np.column_stack([u.ravel(), v.ravel()]))
    T_base_camera = T_base_tool @ setup.camera.T_tool_camera
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T_base_camera[:3, :3].T
    rays = np.ascontiguousarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    joint, every = scene.world, np.ones(len(rays), dtype=bool)
    met, faces = first_hits(
        rays, np.ascontiguousarray(T_base_camera[:3, 3]), joint.corners, joint.bend, every
    )
    laser = setup.laser
    aside = (transform(invert(T_base_tool), met) @ laser.plane[:3] + laser.plane[3]).reshape(shape)
    faces = np.asarray(faces).reshape(shape)
    background, light = world.mean_light(T_base_tool, True, scene.arc_on)
    if not stripe_runs_along_rows(setup):
        aside, faces, background, light = aside.T, faces.T, background.T, light.T
    noise = np.sqrt(background + light + setup.sensor.read_noise_e**2)
    return _centred(_crossings(aside, faces, light, noise), light, width_px)


def _crossings(aside: Float64, faces: Integers, light: Float64, noise: Float64) -> Float64:
    """Return the row of the brightest crossing in each column (n,); see `stripe_truth`."""
    upper, lower = aside[:-1], aside[1:]
    is_met = (faces[:-1] == faces[1:]) & (faces[1:] >= 0) & (upper * lower <= 0.0) & (upper != lower)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(is_met, upper / (upper - lower), 0.0)
    there = light[:-1] + share * (light[1:] - light[:-1])
    is_seen = is_met & (there >= MIN_LIGHT_SIGMAS * noise[:-1])
    brightness = np.where(is_seen, there, -1.0)
    row = np.argmax(brightness, axis=0)
    columns = np.arange(aside.shape[1])
    return np.where(brightness[row, columns] >= 0.0, row + share[row, columns], math.nan)


def _centred(rows: Float64, light: Float64, width_px: float) -> Float64:
    """Return the centroids of light (H, W) near rows (W,): within `NEAR_SIGMAS` of the stripe."""
    every, centre = np.arange(len(light))[:, np.newaxis], rows
    for _ in range(CENTRING_STEPS):
        near = np.where(np.abs(every - centre) <= NEAR_SIGMAS * width_px, light, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = (near * every).sum(axis=0) / near.sum(axis=0)
    return np.where(np.isfinite(rows), centre, math.nan)


def _pixel(setup: Setup, seam_mm: Float64) -> Float64:
    """Return the pixel (2,) at which a point of the tool frame is seen, NaN where there is none."""
    if math.isnan(seam_mm[0]):
        return np.full(2, math.nan)
    at_camera = transform(invert(setup.camera.T_tool_camera), seam_mm)
    return np.asarray(setup.camera.project(at_camera[np.newaxis])[0])


def write_scene(scene: BenchScene, folder: Path) -> None:
    """Write a scene as a recording with its truth, and truth_stripe.csv; ArctrackError if it is there."""
    path = folder / scene.name
    with RecordingWriter(path, scene.setup) as recording:
        first, last = scene.frames[0], scene.frames[-1]
        recording.write_pose(first.frame.timestamp_s - MARGIN_S, first.pose.T_base_tool)
        for each in scene.frames:
            recording.write_frame(each.frame)
            recording.write_pose(each.frame.timestamp_s, each.pose.T_base_tool)
            if not math.isnan(each.seam_mm[0]):
                recording.write_truth(each.frame.index, each.seam_mm)
        recording.write_pose(last.frame.timestamp_s + MARGIN_S, last.pose.T_base_tool)
    numbers = [each.frame.index for each in scene.frames]
    stripes = [
        (number, line, f"{position:.4f}")
        for number, each in zip(numbers, scene.frames, strict=True)
        for line, position in enumerate(each.stripe_px)
        if not math.isnan(position)
    ]
    _write_csv(path / TRUTH_STRIPE, ("frame", "line", "position_px"), stripes)


def _write_csv(path: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([names, *rows])


def read_scene(path: Path) -> BenchScene:
    """Read a scene back; ArctrackError where its recording or its truth cannot be read."""
    recording = arctrack.read_recording(path)
    poses = recording.pose_buffer()
    camera = recording.setup.camera
    n_lines = camera.width if stripe_runs_along_rows(recording.setup) else camera.height
    stripes: dict[int, Float64] = {}
    for row in _rows(path / TRUTH_STRIPE):
        line = stripes.setdefault(int(row["frame"]), np.full(n_lines, math.nan))
        line[int(row["line"])] = float(row["position_px"])
    truth = read_truth(path)
    seams = {} if truth is None else dict(zip(truth.frames.tolist(), truth.seam_tool_mm, strict=True))
    frames = []
    for frame in recording.frames():
        if not isinstance(frame, Frame):
            raise in_file(path, f"{frame}")
        pose = recording.pose_at(poses, frame.timestamp_s)
        if pose is None:
            raise in_file(path, f"frame {frame.index} has no pose")
        seam = seams.get(frame.index, np.full(3, math.nan))
        stripe = stripes.get(frame.index, np.full(n_lines, math.nan))
        frames.append(TruthFrame(frame, pose, stripe, seam, _pixel(recording.setup, seam)))
    return BenchScene(path.name, path.name.partition("_")[0], recording.setup, tuple(frames))


def _rows(path: Path) -> Iterator[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            yield from csv.DictReader(file)
    except OSError as error:
        asked = f"is {path.parent} a scene of the benchmark?"
        raise in_file(path, f"cannot be read: {error.strerror}; {asked}") from None
