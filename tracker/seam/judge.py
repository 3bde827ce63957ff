"""From a look's joint to what a step says of the seam and the torch: judged, remembered and steered by."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.scene import Scene
from noise_model.kernel import kernel
from tracker import checks
from tracker.checks import Asked, ask
from tracker.seam.correction import CorrectionNumbers
from tracker.seam.expected import ExpectedSeam
from tracker.seam.gaussian_process import WIDE_SIGMA_MM
from tracker.seam.locate import SeamSource, confidence
from tracker.seam.steer import Lead, Steering, TorchOffset, steer
from tracker.seam.stretches import Stretches, followed, see
from tracker.state import Pair

MAX_OFF_MM = 3.0 * WIDE_SIGMA_MM
"""A seam so far off its nominal line is none: the line would be another joint's."""


class SeamShown(NamedTuple):
    """Whether a frame shows the seam, and where, NaN if not: in the tool frame, mm, 1 sigmas and confidence.

    The sigmas of y and z, mm, take in the hand-eye tolerance.
    """

    is_shown: bool
    seam_tool_mm: tuple[float, float, float]
    sigma_y_mm: float
    sigma_z_mm: float
    confidence: float


NO_SEAM = SeamShown(False, (math.nan, math.nan, math.nan), math.nan, math.nan, math.nan)
"""What a frame without a seam shows."""


class Judged(NamedTuple):
    """What is remembered and handed on, the seam that is shown, and the offset at the torch."""

    stretches: Stretches
    steering: Steering
    shown: SeamShown
    offset: TorchOffset


@kernel(allocates=True)
def judge(
    asked: Asked,
    source: SeamSource,
    correction: CorrectionNumbers,
    before: Stretches,
    steering: Steering,
    n: int,
    expected: ExpectedSeam,
    scene: Scene,
    joint_mm: Pair,
    variance_mm2: Pair,
    has_stripe: bool,
    timestamp_s: float,
    lead: Lead,
) -> Judged:
    """Judge the joint that a look at the n-th frame shows at (y, z) of its scene, mm; NaN for none.

    `variance_mm2` are those of the joint's y and z; `has_stripe` says whether the frame shows a stripe.
    """
    shown = NO_SEAM
    stretches = Stretches(
        before.history,
        before.beyond,
        before.behind,
        before.jumps,
        before.jumped_at,
        before.lost + (1 if has_stripe else 0),
    )
    if not math.isnan(joint_mm[0]):
        seen = see(
            source,
            expected.scene.T_joint_tool,
            scene,
            joint_mm[0],
            joint_mm[1],
            variance_mm2,
            before.history,
        )
        off_mm, (hand_eye_y, hand_eye_z) = seen.located.displacement_mm, seen.located.hand_eye_mm2
        if ask(asked, checks.NEAR_NOMINAL, max(abs(off_mm[0]), abs(off_mm[1])), MAX_OFF_MM):
            stretches = followed(asked, before, n, seen)
            steering = Steering(steering.ends, steering.is_stopped, seen.located.hand_eye_mm2)
            sigma_y_mm = math.sqrt(variance_mm2[0] + hand_eye_y)
            sigma_z_mm = math.sqrt(variance_mm2[1] + hand_eye_z)
            shown = SeamShown(
                True,
                seen.located.seam_tool_mm,
                sigma_y_mm,
                sigma_z_mm,
                confidence(source.weld_mm, sigma_y_mm, sigma_z_mm),
            )
    steering, offset = steer(
        asked,
        correction,
        source.weld_mm,
        expected,
        stretches,
        steering,
        shown.is_shown,
        timestamp_s,
        lead,
    )
    return Judged(stretches, steering, shown, offset)
