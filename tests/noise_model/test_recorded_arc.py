"""The predicted arc image against what another renderer recorded, where that lies beside the project."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from arctrack.recording.setup_file import read_setup_file
from noise_model.arc.map import arc_at, arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.arc_source import level
from noise_model.instrument.camera import Rays

RECORDINGS = Path(__file__).parents[2].parent / "shared" / "recordings"
BLOCK_PX = 9
STEP_PX = 3
"""The prediction is smooth within a block: every third pixel of every third row stands for it."""

DARK_E = 100.0

SHADOW_EDGE = 0.25
"""By how much of itself light changes across a block at a shadow's edge.

There the tolerance of hand_eye, some 2 px, is worth 5 %: the edge's place would be compared, not its light.
"""


def block_means(image, side):
    rows, columns = (n // side for n in image.shape)
    trimmed = image[: rows * side, : columns * side].astype(np.float64)
    return trimmed.reshape(rows, side, columns, side).mean(axis=(1, 3))


def read_frames(folder):
    """Yield (row of frames.csv, image, T_base_tool by interpolation) of every frame."""
    poses = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    turns = Slerp(poses[:, 0], Rotation.from_quat(poses[:, 4:]))
    with (folder / "frames.csv").open() as rows:
        for row in csv.DictReader(rows):
            time_s = float(row["timestamp_s"])
            T_base_tool = np.eye(4)
            T_base_tool[:3, :3] = turns(time_s).as_matrix()
            T_base_tool[:3, 3] = [np.interp(time_s, poses[:, 0], poses[:, i]) for i in (1, 2, 3)]
            path = folder / "frames" / f"{int(row['frame']):06d}.png"
            yield row, cv2.imread(str(path), cv2.IMREAD_UNCHANGED), T_base_tool


def block_ratios(setup, row, image_dn, T_base_tool, black_dn):
    """Recorded over predicted light of the blocks away from edges, from saturation and from darkness."""
    rays = Rays.of(setup.camera)
    middle = slice(STEP_PX // 2, None, STEP_PX)
    xy, cos4 = rays.xy[middle, middle].reshape(-1, 2), rays.cos4[middle, middle]
    output = level(setup.arc, float(row["current_a"])) * float(row["exposure_s"]) / setup.camera.exposure_s
    kernel = arc_kernel(setup, make_scene(setup, T_base_tool), output)
    mean_e, faces = arc_at(kernel, xy, cos4.reshape(-1), np.arange(cos4.size))
    predicted, face = mean_e.reshape(cos4.shape), faces.reshape(cos4.shape).astype(np.float32)
    around = np.ones((3, 3), dtype=np.uint8)
    unfit = (cv2.dilate(face, around) != cv2.erode(face, around)) | (face < 0)
    change = (cv2.dilate(predicted, around) - cv2.erode(predicted, around)) * BLOCK_PX / (2 * STEP_PX)
    unfit |= change > SHADOW_EDGE * predicted
    is_full = block_means(image_dn >= np.iinfo(image_dn.dtype).max, BLOCK_PX) > 0
    want = block_means(predicted, BLOCK_PX // STEP_PX)
    fit = (block_means(unfit, BLOCK_PX // STEP_PX) == 0) & ~is_full & (want > DARK_E)
    recorded = (image_dn.astype(np.float64) - black_dn) * setup.sensor.gain_e_per_dn
    return block_means(recorded, BLOCK_PX)[fit] / want[fit]


@pytest.mark.skipif(not RECORDINGS.exists(), reason="the shared recordings are not beside the repository")
@pytest.mark.parametrize("name", ["v_nominal", "lap_nominal", "cor_nominal"])
def test_the_arc_alone_looks_as_recorded(name):
    """After one level per recording each frame's median is within 1 %, 90 % of its blocks within 5 %."""
    setup = read_setup_file(RECORDINGS / name / "recording.toml").setup
    assert setup.sensor.gamma == 1.0
    frames = list(read_frames(RECORDINGS / name))
    black_dn = np.mean([dn.mean() for row, dn, _ in frames if row["laser_on"] == row["arc_on"] == "0"])
    assert black_dn == pytest.approx(setup.sensor.black_level_dn, abs=4.0 * setup.tolerance.black_level_dn)
    lit = [frame for frame in frames if frame[0]["arc_on"] == "1" and frame[0]["laser_on"] == "0"]
    ratios = [block_ratios(setup, *frame, black_dn) for frame in lit]
    assert len(ratios) >= 3
    arc_level = np.median(np.concatenate(ratios))
    assert arc_level == pytest.approx(1.0, abs=4.0 * setup.tolerance.arc_level_rel)
    for ratio in ratios:
        assert len(ratio) > 500
        assert np.median(ratio) / arc_level == pytest.approx(1.0, abs=0.01)
        assert np.mean(np.abs(ratio / arc_level - 1.0) < 0.05) > 0.9
