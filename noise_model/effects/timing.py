"""Timing: the poses' clock against the frames'."""

from __future__ import annotations

from noise_model.effects.effect import Effect, Stage
from noise_model.fit import Parameter

EFFECTS = (
    Effect(
        id="pose_delay",
        stage=Stage.TIMING,
        summary="the poses' clock is late or early",
        equation="the tool's pose at a frame's time t is the one that the controller stamps t + delay_s",
        source="a fieldbus cycle and the controller's filter delay a pose by 5 to 50 ms",
        parameters=(Parameter("delay_s", "s", 0.0, 0.03, -0.5, 0.5, 5e-5),),
        typical={"delay_s": 0.05},
    ),
)
