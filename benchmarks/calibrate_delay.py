"""The poses' delay on random recordings of known truth: bias, coverage, and error over the least possible.

    python benchmarks/calibrate_delay.py [--worlds WORLDS] [--seed SEED] [--rendered RENDERED]

Each world has a seam, a path of the tool and a controller of its own, drawn here: the seam is a sum of
cosines, the tool weaves, rises and tilts, the controller rounds and jitters. Where the camera sees the seam
point is solved for and scattered. `--rendered` adds whole recordings, simulated with `pose_delay` and
tracked.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from arctrack.nominal import nominal_setup
from arctrack.recording import read_recording
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from calibration.pose_delay import PoseTrack, estimate_pose_delay, fit_pose_delay
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from tracker.seam_observations import SeamObservations

BEND_LENGTH_MM, N_WAVES = 30.0, 60
SHEET_MM = 35.0
"""The seam is a sum of cosines with the spectrum of a curve that bends over this length."""


RENDERED_JOINTS = ("v_groove", "lap", "fillet", "butt")


@dataclass(frozen=True)
class World:
    """What is drawn: the seam's waves, the tool's motion, the delay, and the noise."""

    setup: Setup
    camera_true: Float64
    waves: Float64
    bends_mm: tuple[float, float]
    offset_mm: Float64
    slope: Float64
    speed_mm_s: float
    weaves: Float64
    delay_s: float
    noise_mm: Float64
    more_noise: float
    frames_s: Float64
    poses_s: Float64
    pose_noise_mm: float

    def seam_mm(self, x_mm: float) -> Float64:
        """Return the seam (3,), mm, base frame, at a station."""
        y, z = (
            self.offset_mm[a]
            + self.slope[a] * x_mm
            + float(np.sum(self.waves[a, 0] * np.cos(self.waves[a, 1] * x_mm + self.waves[a, 2])))
            for a in (0, 1)
        )
        return np.array([x_mm, y, z])

    def seam_slope(self, x_mm: float) -> Float64:
        """Return the seam's slopes (2,), y and z."""
        return np.array(
            [
                self.slope[a]
                - float(
                    np.sum(
                        self.waves[a, 0]
                        * self.waves[a, 1]
                        * np.sin(self.waves[a, 1] * x_mm + self.waves[a, 2])
                    )
                )
                for a in (0, 1)
            ]
        )

    def tool(self, time_s: float) -> Float64:
        """Return T_base_tool (4, 4), mm, where the tool really is."""
        amplitude, rate, phase = self.weaves
        swing = amplitude * np.sin(rate * time_s + phase)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", [swing[2], swing[3], 0.5 * swing[3]], degrees=True).as_matrix()
        T[:3, 3] = [self.speed_mm_s * time_s, swing[0], swing[1]]
        return T

    def seen(self, time_s: float) -> Float64:
        """Return the seam point (3,), mm, tool frame, in the laser sheet at a time."""
        T, laser = self.tool(time_s), self.setup.laser

        def in_tool(x_mm: float) -> Float64:
            return np.asarray(T[:3, :3].T @ (self.seam_mm(x_mm) - T[:3, 3]))

        ahead_mm = self.speed_mm_s * time_s + SHEET_MM
        x_mm = brentq(
            lambda x: float(laser.plane[:3] @ in_tool(x)) + laser.plane[3], ahead_mm - 30.0, ahead_mm + 30.0
        )
        return in_tool(x_mm)


def projected(setup: Setup, T_tool_camera: Float64, points_tool: Float64) -> Float64:
    """Return image points (n, 2) of points (n, 3), mm, by a pinhole."""
    in_camera = (points_tool - T_tool_camera[:3, 3]) @ T_tool_camera[:3, :3]
    camera = setup.camera
    return np.column_stack(
        [
            camera.fx * in_camera[:, 0] / in_camera[:, 2] + camera.cx,
            camera.fy * in_camera[:, 1] / in_camera[:, 2] + camera.cy,
        ]
    )


def turned(T: Float64, change: Float64) -> Float64:
    """Return a pose turned and moved in its own frame by (6,), deg and mm."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(change[:3], degrees=True).as_matrix()
    step[:3, 3] = change[3:]
    return np.asarray(T @ step)


def draw_world(draw: np.random.Generator) -> World:
    """Draw a seam, a motion, a controller and a delay."""
    setup = nominal_setup("butt", "mild_steel")
    sigma = np.repeat([setup.tolerance.hand_eye_deg, setup.tolerance.hand_eye_mm], 3)
    rate_hz, n = float(draw.uniform(8.0, 25.0)), int(draw.integers(40, 120))
    frames_s = 1.0 + np.arange(n) / rate_hz
    pose_hz = float(draw.uniform(50.0, 250.0))
    poses_s = np.arange(0.0, frames_s[-1] + 1.0, 1.0 / pose_hz)
    bends_mm = (float(draw.uniform(0.1, 1.0)), float(draw.uniform(0.005, 0.05)))
    waves = np.stack(
        [
            np.stack(
                [
                    np.full(N_WAVES, bend_mm * math.sqrt(2.0 / N_WAVES)),
                    draw.standard_normal(N_WAVES) / BEND_LENGTH_MM,
                    draw.uniform(0.0, 2.0 * math.pi, N_WAVES),
                ]
            )
            for bend_mm in bends_mm
        ]
    )
    most = np.array([4.0, 1.5, 3.0, 3.0]) * draw.random() * (draw.random(4) < 0.8)
    weaves = np.stack(
        [
            most * draw.uniform(0.3, 1.0, 4),
            2.0 * math.pi / draw.uniform(0.8, 3.5, 4),
            draw.uniform(0.0, 6.3, 4),
        ]
    )
    return World(
        setup=setup,
        camera_true=turned(setup.camera.T_tool_camera, sigma * draw.standard_normal(6)),
        waves=waves,
        bends_mm=bends_mm,
        offset_mm=draw.normal(0.0, 1.0, 2),
        slope=draw.normal(0.0, 0.01, 2),
        speed_mm_s=float(draw.uniform(3.0, 15.0)),
        weaves=weaves,
        delay_s=float(draw.uniform(-0.08, 0.08)),
        noise_mm=draw.uniform(0.02, 0.1, 2),
        more_noise=float(draw.uniform(0.0, 0.6)),
        frames_s=frames_s,
        poses_s=poses_s + draw.uniform(-0.1, 0.1, len(poses_s)) / pose_hz,
        pose_noise_mm=float(draw.uniform(0.0, 0.02)),
    )


def observed(world: World, draw: np.random.Generator) -> tuple[SeamObservations, PoseTrack]:
    """Return what the frames show of the seam, and the poses as the controller stamps them."""
    setup = world.setup
    points = np.stack([world.seen(t) for t in world.frames_s])
    real_mm = world.noise_mm * math.sqrt(1.0 + world.more_noise**2)
    points[:, 1:] += real_mm * draw.standard_normal((len(points), 2))
    # A seam point slides along the sheet, which stands across the tool's x.
    image = projected(setup, world.camera_true, points)
    stamped = world.poses_s + world.delay_s
    T = np.stack([world.tool(t) for t in world.poses_s])
    T[:, :3, 3] = np.round(T[:, :3, 3] + world.pose_noise_mm * draw.standard_normal((len(T), 3)), 3)
    track = PoseTrack.through(stamped, T)
    variances = np.broadcast_to(world.noise_mm**2, (len(points), 2))
    return SeamObservations(image, world.frames_s, variances, (track.at_time,) * len(points)), track


def min_sigma_s(world: World) -> float:
    """Return Cramer and Rao's bound, 1 sigma, of a seam of known spectrum and noise of known size."""
    setup, step_s = world.setup, 1e-4
    tools = [world.tool(t) for t in world.frames_s]
    points = np.stack([world.seen(t) for t in world.frames_s])
    base = np.stack([T[:3, :3] @ p + T[:3, 3] for T, p in zip(tools, points, strict=True)])
    later = np.stack([world.tool(t + step_s) for t in world.frames_s])
    moved = np.einsum("nij,nj->ni", later[:, :3, :3], points) + later[:, :3, 3]
    speed = (moved - base) / step_s
    sigma = np.repeat([setup.tolerance.hand_eye_deg, setup.tolerance.hand_eye_mm], 3)
    image = projected(setup, setup.camera.T_tool_camera, points)
    camera = []
    for k in range(6):
        T_tool_camera = turned(setup.camera.T_tool_camera, 1e-3 * np.eye(6)[k])
        rays = (
            np.column_stack(
                [
                    (image[:, 0] - setup.camera.cx) / setup.camera.fx,
                    (image[:, 1] - setup.camera.cy) / setup.camera.fy,
                    np.ones(len(image)),
                ]
            )
            @ T_tool_camera[:3, :3].T
        )
        origin, laser = T_tool_camera[:3, 3], setup.laser
        length = -(laser.plane[:3] @ origin + laser.plane[3]) / (rays @ laser.plane[:3])
        shift = origin + length[:, np.newaxis] * rays - points
        camera.append(np.einsum("nij,nj->ni", np.stack(tools)[:, :3, :3], shift) * 1e3 * sigma[k])
    information = 0.0
    for a in (0, 1):
        slopes = np.array([world.seam_slope(x)[a] for x in base[:, 0]])
        J = speed[:, a + 1] - slopes * speed[:, 0]
        H = np.stack([shift[:, a + 1] - slopes * shift[:, 0] for shift in camera])
        apart = base[:, :1] - base[:, 0]
        along = base[:, 0] - base[:, 0].mean()
        covariance = world.bends_mm[a] ** 2 * np.exp(-0.5 * (apart / BEND_LENGTH_MM) ** 2) + H.T @ H
        covariance += 1.0 + 1e-4 * np.outer(along, along)
        own = world.noise_mm[a] ** 2 * (1.0 + world.more_noise**2) + 0.6 * world.pose_noise_mm**2
        information += float(J @ np.linalg.solve(covariance + own * np.eye(len(J)), J))
    return 1.0 / math.sqrt(information) if information > 0.0 else math.inf


def judge(worlds: int, seed: int) -> None:
    """Print bias, coverage and error over the bound; and which worlds have no answer."""
    z, error, sigma, unestimated, wrong = [], [], [], [], 0
    for number in range(worlds):
        draw = np.random.default_rng([seed, number])
        world = draw_world(draw)
        bound_s = min_sigma_s(world)
        observations, track = observed(world, draw)
        result = fit_pose_delay(world.setup, observations, track)
        if result.unestimated is not None:
            unestimated.append(bound_s)
            continue
        off_s = result.delay_s - world.delay_s
        z.append(off_s / result.sigma_s)
        error.append(off_s / bound_s)
        sigma.append(result.sigma_s / bound_s)
        wrong += abs(z[-1]) > 5.0
    n = len(z)
    print(f"{n} delays estimated, {len(unestimated)} unestimated; {wrong} off by more than five sigmas")
    print(f"the bound where unestimated: {1e3 * min(unestimated, default=math.nan):.1f} ms and more")
    print(
        f"bias {np.mean(z) / np.std(z) * math.sqrt(n):+.2f} standard errors (limit {norm.isf(0.00135):.1f})"
    )
    print(f"covered {100.0 * np.mean(np.abs(z) < norm.isf(0.025)):.1f} % by 95 % intervals")
    print(
        f"error over bound {np.sqrt(np.mean(np.square(error))):.2f}, sigma over bound {np.median(sigma):.2f}"
    )


def judge_rendered(count: int, seed: int) -> None:
    """Print the delay of whole recordings, rendered with one and tracked."""
    z = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            draw = np.random.default_rng([seed, number])
            joint = RENDERED_JOINTS[number % len(RENDERED_JOINTS)]
            setup = balance(nominal_setup(joint, "mild_steel", width=320, height=240))
            delay_s = float(draw.uniform(-0.06, 0.06))
            plan = SimulationPlan(frames=36, seed=1000 * seed + number, production=True)
            hidden = {"pose_delay": {"delay_s": delay_s}}
            read = read_recording(simulate_recording(Path(folder) / str(number), setup, plan, None, hidden))
            frames, _ = read.readable_frames()
            track = PoseTrack.through(read.poses.timestamps_s, read.poses.T_base_tool)
            result = estimate_pose_delay(read.setup, frames, track)
            z.append((result.delay_s - delay_s) / result.sigma_s)
            print(
                f"{joint:10} true {1e3 * delay_s:+6.1f} ms, found {1e3 * result.delay_s:+6.1f} ± "
                f"{1e3 * result.sigma_s:.1f} ms, {z[-1]:+.1f} sigmas {result.unestimated or ''}",
                flush=True,
            )
    print(f"RMS of error over sigma {np.sqrt(np.mean(np.square(z))):.2f}")


def main() -> None:
    """Judge the delay's calibration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rendered", type=int, default=0)
    chosen = parser.parse_args()
    if chosen.worlds:
        judge(chosen.worlds, chosen.seed)
    if chosen.rendered:
        judge_rendered(chosen.rendered, chosen.seed)


if __name__ == "__main__":
    main()
