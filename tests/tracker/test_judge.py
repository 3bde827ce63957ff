"""What a step does after its look: the compiled judge against plain Python, along seams that jump and end."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from judge_twin import plain_confidence, plain_steer
from rendered import pose_at, small_setup

from tracker import checks, flags
from tracker.checks import Asked, ask, ask_whether
from tracker.seam.correction import AxisCorrection, Correction
from tracker.seam.expected import ExpectedSeam, expect_seam
from tracker.seam.judge import MAX_OFF_MM, Judged, judge
from tracker.seam.locate import SeamSource
from tracker.seam.steer import Lead, Steering
from tracker.seam.stretches import Stretches, followed, see
from tracker.step import TrackerState

SEAMS, FRAMES, STEP_MM = 32, 70, 1.7
VARIANCE_MM2 = (4e-4, 9e-4)
NO_JOINT = (math.nan, math.nan)


def drawn_source(i: int) -> SeamSource:
    """A joint from 10 to 90 mm; every fourth is corrugated."""
    setup = small_setup("v_groove" if i % 4 else "corrugation")
    short = replace(setup.joint, seam_in_base_mm=((10.0, 0.0, 0.0), (90.0, 0.0, 0.0)))
    return SeamSource.of(replace(setup, joint=short))


def drawn_correction(rng: np.random.Generator) -> Correction:
    limit_mm, at_limit = rng.choice([math.inf, 1.0]), "stop" if rng.random() < 0.2 else "saturate"
    lost = ("hold", "extrapolate", "stop")[rng.integers(3)]
    return Correction(
        y=AxisCorrection(gain=float(rng.choice([1.0, 0.8])), limit_mm=float(limit_mm), at_limit=at_limit),
        z=AxisCorrection(enable=bool(rng.random() < 0.7), bias_mm=0.1),
        when_lost=lost,
        ends_mm=float(rng.choice([0.0, 30.0])),
        corrugation="followed" if rng.random() < 0.5 else "in_path",
    )


def drawn_joints(
    rng: np.random.Generator, height_mm: float, is_lost: bool
) -> Iterator[tuple[tuple[float, float], bool]]:
    """A joint's place in each look, NaN for none, and whether the frame is dark; `is_lost` has a hole."""
    starts, ends, aside_mm = rng.uniform(0.0, 20.0), rng.uniform(75.0, 110.0), 0.0
    for n in range(FRAMES):
        if rng.random() < 0.07:
            aside_mm = float(rng.normal(0.0, 1.2))
        is_dark, station = bool(rng.random() < 0.08), STEP_MM * n
        is_missed = is_dark or rng.random() < 0.08 or not starts < station < ends
        if is_missed or (is_lost and 30.0 < station < 60.0):
            yield NO_JOINT, is_dark
            continue
        far_mm = 40.0 if rng.random() < 0.03 else 0.0
        y_mm, z_mm = rng.normal((aside_mm + far_mm, height_mm), 0.02)
        yield (float(y_mm), float(z_mm)), is_dark


def assert_same(told: Any, twin: Any) -> None:
    """Hold numbers and records of them to their twin's."""
    if isinstance(twin, tuple):
        for a, b in zip(told, twin, strict=True):
            assert_same(a, b)
        return
    np.testing.assert_allclose(told, twin, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_what_a_look_leaves_and_what_the_torch_gets_are_their_twins() -> None:
    """With each question, its value and its limit in the order in which they are asked."""
    raised, n_past = 0, 0
    for i in range(SEAMS):
        rng, source = np.random.default_rng(i), drawn_source(i)
        correction, lead = drawn_correction(rng), Lead(0.1, float(rng.uniform(0.0, 3.0)))
        state = TrackerState()
        before = Stretches(state.history, state.beyond, state.behind, 0, 0, 0)
        steering = state.steering
        for n, (joint_mm, is_dark) in enumerate(drawn_joints(rng, source.height_mm, i % 3 == 0), 1):
            expected = expect_seam(source, pose_at(STEP_MM * n - 35.0).T_base_tool, before.history)
            told, asked = Asked.nothing(), Asked.nothing()
            for each in (told, asked):
                ask_whether(each, checks.LASER_ON, not is_dark)
            look = n, expected, expected.scene, joint_mm, VARIANCE_MM2, not is_dark, 0.04 * n, lead
            judged: Judged = judge(told, source, correction.numbers, before, steering, *look)
            shown, after, hand_eye_mm2 = plain_look(asked, source, before, n, expected, joint_mm, is_dark)
            if shown:
                steering = Steering(steering.ends, steering.is_stopped, hand_eye_mm2)
                sigma_mm = np.sqrt(np.add(VARIANCE_MM2, hand_eye_mm2))
                assert_same((judged.shown.sigma_y_mm, judged.shown.sigma_z_mm), tuple(sigma_mm))
                assert_same(judged.shown.confidence, plain_confidence(source.weld_mm, [*sigma_mm]))
            else:
                assert np.isnan([*judged.shown.seam_tool_mm, *judged.shown[2:]]).all()
            steering, offset = plain_steer(
                asked, correction, source.weld_mm, expected, after, steering, shown, 0.04 * n, lead
            )
            assert judged.shown.is_shown == shown
            assert_same(judged.stretches, after)
            assert_same(judged.steering, steering)
            assert_same(judged.offset[:6], (*offset.offset_mm, *offset.sigma_mm, *offset[2:]))
            assert told.flags == asked.flags
            assert_same(told.rows[: told.told[0]], asked.rows[: asked.told[0]])
            before, raised, n_past = after, raised | told.flags, max(n_past, len(after.behind.ends))
    # What the seams are drawn for.
    drawn_for = flags.names(raised)
    assert {"seam_jump", "offset_held", "offset_extrapolated", "offset_unknown"} <= set(drawn_for)
    assert {"before_joint", "past_joint", "follow_stopped", "offset_limited"} <= set(drawn_for)
    assert n_past > 1


def plain_look(
    asked: Asked,
    source: SeamSource,
    before: Stretches,
    n: int,
    expected: ExpectedSeam,
    joint_mm: tuple[float, float],
    is_dark: bool,
) -> tuple[bool, Stretches, tuple[float, float]]:
    """Whether the seam is shown, what is remembered, and what the hand-eye tolerance leaves, mm^2."""
    if not math.isnan(joint_mm[0]):
        T_joint_tool = expected.scene.T_joint_tool
        seen = see(source, T_joint_tool, expected.scene, *joint_mm, VARIANCE_MM2, before.history)
        off_mm = max(map(abs, seen.located.displacement_mm))
        if ask(asked, checks.NEAR_NOMINAL, off_mm, MAX_OFF_MM):
            return True, followed(asked, before, n, seen), seen.located.hand_eye_mm2
    return False, before._replace(lost=before.lost + (not is_dark)), NO_JOINT
