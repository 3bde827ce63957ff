"""Another renderer's recordings of a plain laser sensor: diagnosed with and without arc, filter and metal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from noise_model.arc_source import NO_ARC
from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from noise_model.surface.brdf import UNSTATED_METAL
from sim_to_real.data.binned import observe
from sim_to_real.diagnose import diagnose
from sim_to_real.diagnosis import Diagnosis, DiagnosisVerdict
from sim_to_real.fit.metal_of_stripe import metal_of_stripe
from tracker.state import Pose
from validation.second_renderer.scenario import MadeRecording, Scenario, StatedSwitches, make
from validation.second_renderer.world_effect import CATALOGUE, HiddenEffect
from validation.second_renderer.world_light import TrueWorld
from validation.second_renderer.world_stated import EXPOSURE_S, draw_stated

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("mitsuba")]

COARSER = 2
"""By so much the camera is coarser than the blind check's."""

LASER = StatedSwitches(True, False, 0.0, EXPOSURE_S)
SWITCHES = (
    *2 * (replace(LASER, laser_on=False),),
    *14 * (LASER,),
    *4 * (replace(LASER, exposure_s=0.5 * EXPOSURE_S),),
)

HIDDEN = {
    "ghost_stripe": {"share": 0.3, "right_px": 6.0, "down_px": 40.0},
    "hand_eye": {"rot_x_deg": 0.4, "rot_y_deg": -0.3, "rot_z_deg": 0.5}
    | {"move_x_mm": 0.4, "move_y_mm": 0.5, "move_z_mm": -0.3},
    "uneven_fan": {"half_deg": 3.0, "edge_deg": 0.5},
    "stripe_profile": {"width_ratio": 1.4, "exponent": 2.5},
}
FORMS = {"uneven_fan": "ends"}


def recorded(joint: str, seed: int, effect: str | None) -> tuple[Scenario, MadeRecording]:
    """Return a run that moves as the blind check's do, the laser its only light."""
    stated, motion = draw_stated(np.random.default_rng(seed), joint)
    stated = replace(stated, camera=stated.camera.coarser(COARSER))
    hidden = () if effect is None else (HiddenEffect(effect, FORMS.get(effect, CATALOGUE), HIDDEN[effect]),)
    scenario = Scenario(seed, "F", stated, TrueWorld(stated, np.eye(4)), motion, SWITCHES, hidden)
    return scenario, make(scenario)


def plain(setup: Setup) -> Setup:
    return replace(setup, arc=NO_ARC, filter=None, material=UNSTATED_METAL)


def diagnosed(joint: str, seed: int, effect: str | None, is_plain: bool) -> Diagnosis:
    scenario, recording = recorded(joint, seed, effect)
    setup = plain(recording.setup) if is_plain else recording.setup
    return diagnose(setup, recording.frames, lambda t: Pose(scenario.motion.T_base_tool(t)))


@pytest.mark.parametrize("is_plain", [False, True])
@pytest.mark.parametrize(("joint", "effect"), [("v_groove", "ghost_stripe"), ("v_groove", "stripe_profile")])
def test_what_the_stripe_shows_is_named_whatever_else_is_stated(
    joint: str, effect: str, is_plain: bool
) -> None:
    diagnosis = diagnosed(joint, 6, effect, is_plain)
    assert diagnosis.verdict is DiagnosisVerdict.EFFECTS
    assert [named.id for named in diagnosis.effects] == [effect]
    assert diagnosis.where.stage == REGISTRY[effect].stage.value
    assert diagnosis.gap.closed > 0.8


@pytest.mark.parametrize("is_plain", [False, True])
def test_a_camera_that_stands_elsewhere_is_named(is_plain: bool) -> None:
    diagnosis = diagnosed("v_groove", 4, "hand_eye", is_plain)
    assert [named.id for named in diagnosis.effects] == ["hand_eye"]
    assert diagnosis.where.stage == "geometry"


@pytest.mark.parametrize("is_plain", [False, True])
@pytest.mark.parametrize(("joint", "seed"), [("v_groove", 4), ("flat", 2)])
def test_nothing_hidden_is_no_gap_whatever_the_metal_is(joint: str, seed: int, is_plain: bool) -> None:
    diagnosis = diagnosed(joint, seed, None, is_plain)
    assert diagnosis.verdict is DiagnosisVerdict.NO_GAP
    assert diagnosis.gap.before < 0.3


def test_the_metal_is_the_one_that_the_stripe_shows() -> None:
    scenario, recording = recorded("v_groove", 4, None)
    observed = observe(
        plain(recording.setup), recording.frames, lambda t: Pose(scenario.motion.T_base_tool(t))
    )
    seen, stated = metal_of_stripe(observed, 1)(observed.setup).material, recording.setup.material
    assert seen.kappa_spec / seen.kappa_diff == pytest.approx(stated.kappa_spec / stated.kappa_diff, rel=0.5)
    assert seen.c2 == pytest.approx(stated.c2, rel=0.3)
