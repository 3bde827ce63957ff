"""A flat plate before the camera of examples/v_groove, whose laser sheet was displaced."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.recording import read_setup_file
from calibration.camera.known_lens import lens_from_camera
from calibration.laser.plane import with_plane
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert, transform

STATED = read_setup_file("examples/v_groove/recording.toml").setup
LENS = lens_from_camera(STATED.camera)
ROBOT_MM, ROBOT_RAD, NOISE_PX = 0.05, 5e-4, 0.1

HEIGHTS = ((0.0, 0.0, 0.0), (8.0, 0.0, 0.0), (-8.0, 0.0, 0.0))
HEIGHTS_AND_TILTS = ((0.0, 0.0, 0.0), (8.0, 0.0, 8.0), (-8.0, 8.0, 0.0))
"""How high the tool is, mm, and its turns about x and y, deg."""

MOTIONS = {
    "raise and lower the tool by 10 mm": ((10.0, 0.0, 0.0), (-10.0, 0.0, 0.0)),
    "tilt the tool by ±15° about its x": ((0.0, 15.0, 0.0), (0.0, -15.0, 0.0)),
    "tilt the tool by ±15° about its y": ((0.0, 0.0, 15.0), (0.0, 0.0, -15.0)),
}
"""The levels of the tool that motions mean."""

FLAT = 0.0


def displaced(rng: np.random.Generator) -> Setup:
    """Return the setup with its sheet turned by up to 2 deg and moved by up to 5 mm."""
    turn = Rotation.from_euler("zy", rng.uniform(-2.0, 2.0, 2), degrees=True).as_matrix()
    normal = turn @ STATED.laser.plane[:3]
    offset = -normal @ [35.0, 0.0, 0.0] + rng.uniform(-5.0, 5.0)
    return replace(STATED, laser=with_plane(STATED.laser, np.array([*normal, offset])))


def pose_at(level: Sequence[float], x_mm: float) -> Float64:
    """Return the tool's pose whose sheet is met at x, as the setup states it."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xy", level[1:], degrees=True).as_matrix()
    T[:3, 3] = [400.0 + x_mm, 50.0, 20.0 + level[0]] - T[:3, :3] @ [35.0, 0.0, 0.0]
    return T


def stripes(
    true: Setup, levels: Sequence[Sequence[float]], rng: np.random.Generator, bend_mm: float = FLAT
) -> list[tuple[Float64, Float64]]:
    """Return the tool's stated poses (4, 4) and the stripe (n, 2), px, on a plate that leans by some degree.

    There are eight at each level of the tool. A bent plate is by `bend_mm` lower at both ends of the travel.
    """
    normal = Rotation.from_euler("xy", rng.normal(0.0, 1.5, 2), degrees=True).as_matrix()[:, 2]
    T_tool_camera, height = true.camera.T_tool_camera, rng.normal(0.0, 3.0)
    shown = []
    for level in levels:
        for x in np.linspace(-20.0, 20.0, 8):
            T = pose_at(level, x)
            turn = Rotation.from_rotvec(ROBOT_RAD * rng.standard_normal(3)).as_matrix()
            really = T.copy()
            really[:3, :3] = turn @ T[:3, :3]
            really[:3, 3] += (T - really)[:3, :3] @ [35.0, 0.0, 0.0] + ROBOT_MM * rng.standard_normal(3)
            plate = np.array([400.0, 50.0, 20.0 + height - bend_mm * (x / 20.0) ** 2])
            m, p = normal @ really[:3, :3], transform(invert(really), plate)
            along = np.cross(m, true.laser.plane[:3])
            middle = np.linalg.lstsq(
                np.stack([m, true.laser.plane[:3], along]),
                np.array([m @ p, -true.laser.plane[3], 0.0]),
                rcond=None,
            )[0]
            points = middle + np.linspace(-12.0, 12.0, 200)[:, np.newaxis] * along / np.linalg.norm(along)
            seen = LENS.project(transform(invert(T_tool_camera), points))
            seen = seen[np.argsort(seen[:, 0])]
            seen[:, 1] += NOISE_PX * rng.standard_normal(len(seen))
            shown.append((T, seen))
    return shown


def write_recording(folder: Path, shown: Sequence[tuple[Float64, Float64]], peak_dn: float = 150.0) -> Path:
    """Write stripes as a recording of the setup as stated; return its folder."""
    (folder / "frames").mkdir(parents=True)
    setup = Path("examples/v_groove/recording.toml").read_text()
    (folder / "recording.toml").write_text(setup)
    frames, poses = (
        ["frame,timestamp_s,laser_on,arc_on,current_a,exposure_s"],
        ["timestamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw"],
    )
    rng, rows = np.random.default_rng(5), np.arange(LENS.height)[:, np.newaxis]
    for n, (T, seen) in enumerate(shown):
        columns = np.arange(LENS.width)
        place = np.interp(columns, *seen.T, left=-99.0, right=-99.0)
        light = peak_dn * np.exp(-0.5 * ((rows - place) / 2.0) ** 2)
        drawn = 10.0 + light + rng.normal(0.0, 1.0, light.shape)
        cv2.imwrite(str(folder / "frames" / f"{n:06d}.png"), drawn.round().clip(0, 255).astype(np.uint8))
        frames.append(f"{n},{0.2 * n:.6f},1,0,0,0.005")
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        times_s = 0.2 * n - 0.05, 0.2 * n + 0.05
        poses += [",".join(f"{value:.9f}" for value in (at_s, *numbers)) for at_s in times_s]
    (folder / "frames.csv").write_text("\n".join(frames) + "\n")
    (folder / "poses.csv").write_text("\n".join(poses) + "\n")
    return folder
