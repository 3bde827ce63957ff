"""Costs of the catalogue before anything is recorded, held against closed forms."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import level_pose

from arctrack.recording import read_recording
from noise_model.effects import REGISTRY, not_predicted
from noise_model.setup_keys import Tolerance
from sim_to_real.decision.setup_cost import (
    SetupTrial,
    SizeKind,
    setup_costs,
    sizes_of_one_sigma,
)
from sim_to_real.search.score_test import FAMILIES

SETUP = replace(read_recording(Path(__file__).parents[2] / "examples" / "v_groove").setup, effects={})
SMALL = replace(SETUP, camera=SETUP.camera.coarser(2))
ACROSS_MM_S = 4.0


def weaving(time_s):
    T_base_tool = level_pose(time_s)
    T_base_tool[1, 3] = ACROSS_MM_S * time_s
    return T_base_tool


def test_one_sigma_is_the_tolerance_where_it_is_stated_else_the_prior():
    stated = replace(SETUP, tolerance=Tolerance(hand_eye_deg=0.2, hand_eye_mm=0.7, black_level_dn=1.5))
    kind, sizes = sizes_of_one_sigma(stated, "hand_eye")
    assert kind is SizeKind.TOLERANCE
    off = [{key: value for key, value in size.items() if value != 0.0} for size in sizes]
    assert off == [
        *({f"rot_{axis}_deg": 0.2} for axis in "xyz"),
        *({f"move_{axis}_mm": 0.7} for axis in "xyz"),
    ]
    assert sizes_of_one_sigma(stated, "black_level") == (SizeKind.TOLERANCE, [{"offset_dn": 1.5}])
    [delay] = REGISTRY["pose_delay"].parameters
    assert sizes_of_one_sigma(stated, "pose_delay") == (SizeKind.PRIOR, [{"delay_s": delay.prior_sigma}])
    assert sizes_of_one_sigma(stated, "laser_speckle")[1] == []
    # A plate without an end cannot be longer.
    assert sizes_of_one_sigma(stated, "plate_outline")[1] == []


@pytest.fixture(scope="module")
def trial():
    return SetupTrial(SMALL, weaving, (0.0, 0.1), 0.0)


def test_a_tolerance_of_the_camera_is_added_in_squares(trial):
    """Along its x axis, the tool's -y, the camera moves the seam by its own way; the rest only adds to it."""
    [one_sigma] = trial.one_sigma("hand_eye")
    tolerance = SMALL.tolerance
    assert one_sigma.kind is SizeKind.TOLERANCE
    parts = [trial.cost("hand_eye", size) for size in sizes_of_one_sigma(SMALL, "hand_eye")[1]]
    assert parts[3].lateral_mm.value == pytest.approx(tolerance.hand_eye_mm, rel=0.01)
    total = math.hypot(*(part.lateral_mm.value for part in parts))
    assert one_sigma.cost.lateral_mm.value == pytest.approx(total)
    assert total > tolerance.hand_eye_mm
    assert set(one_sigma.cost.values.values()) == {tolerance.hand_eye_mm, tolerance.hand_eye_deg}


def test_a_late_clock_costs_its_way_across(trial):
    cost = trial.cost("pose_delay", {"delay_s": 0.05})
    assert cost.lateral_mm.value == pytest.approx(0.05 * ACROSS_MM_S, abs=1e-6)
    assert cost.vertical_mm.value == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
def test_every_effect_has_a_cost_at_its_typical_size():
    done = []
    costs = setup_costs(SMALL, weaving, (0.1,), 0.0, lambda n, total: done.append((n, total)))
    names = [name for name in REGISTRY if name not in not_predicted(SMALL)]
    typical = [each.cost for each in costs if each.kind is SizeKind.TYPICAL]
    assert {cost.id for cost in typical} == set(names)
    assert done == [(n + 1, len(names)) for n in range(len(names))]
    # Typical ones come first, each kind the largest first.
    assert [each.cost for each in costs[: len(typical)]] == typical
    sizes = [cost.max_mm for cost in typical if cost.is_rendered]
    assert sizes == sorted(sizes, reverse=True)
    others = {each.cost.id: each.cost for each in costs[len(typical) :]}
    assert others.keys() <= FAMILIES.keys()
    assert {cost.id for cost in typical if not cost.is_rendered} == {"interreflection", "read_noise"}
    # A camera that is off by half a degree costs most of what the tracker survives; a stray light little.
    known = {cost.id: cost.max_mm for cost in typical if math.isfinite(cost.max_mm)}
    assert max(known, key=known.get) == "hand_eye"
    assert known["black_level"] < 0.01


def test_without_a_seam_nothing_has_a_cost():
    away = level_pose(0.0)
    away[:3, 3] = 0.0, 200.0, 0.0
    lost = SetupTrial(SMALL, lambda _: away, (0.0,), 0.0)
    for name, values in (("gamma", {"gamma": 0.9, "bend": 0.0}), ("pose_delay", {"delay_s": 0.05})):
        cost = lost.cost(name, values)
        assert (cost.flag.value, cost.n_frames) == ("no_seam", 0)
        assert np.isnan(cost.lateral_mm.value)
