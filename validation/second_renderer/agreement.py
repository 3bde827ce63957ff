"""How well the predicted arc images agree with the recorded ones, after one level per recording.

The measure is free of the prediction's own noise model: ratios of block means, away from edges of the joint,
from saturation and from darkness. The black level is the dark frames' own where there are any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.condition import Condition
from noise_model.effects import apply_setup_effects
from noise_model.forward import Renderer, predict
from noise_model.instrument.sensor import linearise, saturation_dn
from noise_model.setup import Setup
from sim_to_real.data.binned import stated_condition
from sim_to_real.data.blocks import block_means, dilate, near_face_edges
from tracker.state import Frame, Pose

BLOCK_PX = 9
"""The side of the blocks that are averaged; also how far a block must lie from edges and saturation."""

DARK_E = 100.0
"""Blocks predicted darker than this say nothing about a ratio."""


@dataclass(frozen=True)
class Agreement:
    """Per frame: its index, the median ratio of recorded over predicted blocks, the share within 5 %.

    `level` is the arc's output over the nominal one, one for all frames; `blocks` (n_frames,) how many blocks
    were compared.
    """

    level: float
    frames: Int64
    median_ratio: Float64
    within_5_percent: Float64
    blocks: Int64


def arc_agreement(setup: Setup, frames: Sequence[tuple[Frame, Pose]]) -> Agreement:
    """Compare the frames that have the arc on and the laser off with their prediction.

    Raises ValueError if there is no such frame, or none with enough light.
    """
    lit = [(f, p) for f, p in frames if f.arc_on and not f.laser_on and f.current_a > 0.0]
    renderer = Renderer()
    setup = _with_black_level(setup, [f for f, _ in frames if not f.arc_on and not f.laser_on])
    indices, ratios = [], []
    for frame, pose in lit:
        condition = stated_condition(setup, frame, frames[0][0].timestamp_s)
        recorded, predicted = _blocks(setup, frame, pose, condition, renderer)
        if len(recorded):
            indices.append(frame.index)
            ratios.append(recorded / predicted)
    if not ratios:
        raise ValueError("no frame shows the arc alone brightly enough to be compared")
    level = float(np.median(np.concatenate(ratios)))
    return Agreement(
        level,
        np.array(indices),
        np.array([float(np.median(r)) / level for r in ratios]),
        np.array([float(np.mean(np.abs(r / level - 1.0) < 0.05)) for r in ratios]),
        np.array([len(r) for r in ratios]),
    )


def _with_black_level(setup: Setup, dark: Sequence[Frame]) -> Setup:
    """Return the setup with the black level of the dark frames; as it is where there are none."""
    if not dark:
        return setup
    black_dn = float(np.mean([frame.image_dn.mean() for frame in dark]))
    return replace(setup, sensor=replace(setup.sensor, black_level_dn=black_dn))


def _blocks(
    setup: Setup, frame: Frame, pose: Pose, condition: Condition, renderer: Renderer
) -> tuple[Float64, Float64]:
    """Return the block means (n,) of one frame, recorded and predicted, e-."""
    true = apply_setup_effects(setup)
    predicted = predict(setup, pose.T_base_tool, condition, renderer=renderer).mean_e
    _, _, faces = renderer.layers(true, pose.T_base_tool).view.surface
    recorded = linearise(frame.image_dn, true.sensor)
    bad = near_face_edges(faces, BLOCK_PX) | dilate(frame.image_dn >= saturation_dn(true.sensor), BLOCK_PX)
    recorded_mean, predicted_mean = block_means(recorded, BLOCK_PX), block_means(predicted, BLOCK_PX)
    good = (block_means(bad, BLOCK_PX) == 0.0) & (predicted_mean > DARK_E)
    return recorded_mean[good], predicted_mean[good]
