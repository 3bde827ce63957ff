"""The robot's path: where the tool stands along it, how well the seam shows there, and where it does not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly
from noise_model.plan.light import stripe_level_e, stripe_light
from noise_model.plan.noise import (
    BLIND,
    SeamNoise,
    Surroundings,
    expected_pixels,
    line_bounds,
    seam_noise,
    speckle_floor_px,
)
from noise_model.setup import Setup
from noise_model.surface.joint import Joint, corrugation_height, seam_frame, section
from noise_model.transforms import invert, transform

STATIONS_A_PITCH = 24
STATIONS_A_SEAM = 60
MAX_STATIONS = 240

SEARCH_STATIONS = 8
"""Stations over one pitch of a corrugation that a search looks at; a straight section needs one."""


@dataclass(frozen=True, eq=False)
class Path:
    """The tool along the seam: stations (n,), mm from the seam's start, and T_base_tool (n, 4, 4), mm.

    `length_mm` is the whole seam's; a path may end before.
    """

    station_mm: Float64
    T_base_tool: Float64
    length_mm: float


@dataclass(frozen=True, eq=False)
class PathNoise:
    """Expected uncertainty of the seam along a path: one `SeamNoise` a station."""

    path: Path
    noise: tuple[SeamNoise, ...]

    def column(self, name: str) -> Float64:
        """Return one of the numbers of all stations (n,)."""
        return np.array([getattr(noise, name) for noise in self.noise])


def nominal_path(setup: Setup) -> Path:
    """Return the path along the nominal seam, the torch upright and following a corrugation's height.

    It ends after `MAX_STATIONS` stations of a corrugation, which repeats itself anyway.
    """
    ends = _segment_lengths(setup.joint)
    length = float(ends[-1])
    step = length / STATIONS_A_SEAM
    if setup.joint.type == "corrugation":
        step = min(step, setup.joint.dimensions["pitch_mm"] / STATIONS_A_PITCH)
    stations = np.arange(0.0, length + 1e-9, step)[:MAX_STATIONS]
    return Path(stations, np.array([_upright(setup, float(s)) for s in stations]), length)


def search_path(setup: Setup) -> Path:
    """Return the few poses by which designs are compared: one pitch of a corrugation, else one pose."""
    length = float(_segment_lengths(setup.joint)[-1])
    stations = np.array([0.0])
    if setup.joint.type == "corrugation":
        stations = np.arange(SEARCH_STATIONS) * setup.joint.dimensions["pitch_mm"] / SEARCH_STATIONS
    return Path(stations, np.array([_upright(setup, float(s)) for s in stations]), length)


def recorded_path(setup: Setup, poses: Sequence[Float64]) -> Path:
    """Return the path of reported poses T_base_tool, thinned to `MAX_STATIONS`, by place on the seam."""
    joint = setup.joint
    T_base_tool = np.array([poses[n] for n in evenly(len(poses), MAX_STATIONS)])
    stations = [transform(invert(seam_frame(joint, T[:3, 3])), T[:3, 3])[0] for T in T_base_tool]
    return Path(np.array(stations) - _first_station(joint), T_base_tool, float(_segment_lengths(joint)[-1]))


def noise_along(
    setup: Setup, path: Path, around: Surroundings, on_station: Callable[[int], None] | None = None
) -> PathNoise:
    """Return the seam's expected uncertainty along a path; `on_station` gets the number of stations done.

    A pose that puts the camera below the surface or the laser off the joint is blind. Raises ValueError for a
    stripe that the setup's camera cannot see on a plate.
    """
    floor_px, level_e = speckle_floor_px(setup, around.speckle_contrast), stripe_level_e(setup)
    noise = []
    for n, T_base_tool in enumerate(path.T_base_tool):
        noise.append(_station(setup, T_base_tool, floor_px, level_e, around))
        if on_station is not None:
            on_station(n + 1)
    return PathNoise(path, tuple(noise))


def _station(
    setup: Setup, T_base_tool: Float64, floor_px: float, level_e: float, around: Surroundings
) -> SeamNoise:
    try:
        light = stripe_light(setup, T_base_tool, level_e)
    except ValueError:
        # A camera below the surface, a laser that misses the joint.
        return BLIND
    bounds = line_bounds(light, expected_pixels(light, setup, around), setup.sensor, floor_px)
    return seam_noise(light, bounds, setup.joint)


def leaned(T_base_tool: Float64, travel_deg: float, work_deg: float) -> Float64:
    """Return a pose with the torch leaned about its own tip, the upper end ahead and to the left."""
    T_tool_leaned = np.eye(4)
    T_tool_leaned[:3, :3] = Rotation.from_euler("yx", [travel_deg, -work_deg], degrees=True).as_matrix()
    return T_base_tool @ T_tool_leaned


def blind_stretches(along: PathNoise, limit_mm: float) -> list[tuple[int, int]]:
    """Return first and last station of each stretch where the seam's sigma is above a limit or unknown."""
    sigma = along.column("sigma_mm")
    blind = np.concatenate([[False], ~(sigma <= limit_mm), [False]])
    edges = np.flatnonzero(np.diff(blind.astype(int)))
    return [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]


def _segment_lengths(joint: Joint) -> Float64:
    """Return the start of each segment of the seam, mm along it, and the whole length last."""
    steps = np.diff(np.asarray(joint.seam_in_base_mm), axis=0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])


def _first_station(joint: Joint) -> float:
    """Return the station, mm, at which the nominal seam begins in the joint's frame."""
    start = np.asarray(joint.seam_in_base_mm[0])
    return float(transform(invert(seam_frame(joint, start)), start)[0])


def _upright(setup: Setup, station_mm: float) -> Float64:
    """Return T_base_tool over a station of the seam."""
    joint = setup.joint
    points = np.asarray(joint.seam_in_base_mm)
    ends = _segment_lengths(joint)
    segment = min(int(np.searchsorted(ends, station_mm, side="right")) - 1, len(points) - 2)
    middle = 0.5 * (points[segment] + points[segment + 1])
    T_base_joint = seam_frame(joint, middle)
    T_joint_tool = np.eye(4)
    x = _first_station(joint) + station_mm
    T_joint_tool[:3, 3] = x, 0.0, float(corrugation_height(np.array(x), section(joint).corrugation))
    return T_base_joint @ T_joint_tool
