"""What an experiment would show, and which one leaves the least open."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from noise_model.condition import Condition
from noise_model.effects import REGISTRY
from sim_to_real.data.binned import ObservedFrame
from sim_to_real.decision.experiments import MENU, WITNESS
from sim_to_real.decision.next_experiment import (
    expected_certainty,
    is_recorded,
    next_measurement,
    planned_frame,
)
from sim_to_real.evidence.hypotheses import Posterior
from sim_to_real.evidence.hypothesis_search import HypothesisSearch
from sim_to_real.evidence.policy import POLICY
from sim_to_real.evidence.weigh import weigh
from sim_to_real.fit.covariates import covariates
from sim_to_real.fit.gauss_newton import refit
from tests.sim_to_real.small import of_stratum, small_recording


def test_an_experiment_that_parts_all_leaves_one():
    weights = np.array([0.5, 0.5])
    apart = np.zeros((2, 2, 3))
    # The first tells nothing, the second all, the third tells only if the first hypothesis is right.
    apart[0, 1], apart[1, 0] = [0.0, 60.0, 60.0], [0.0, 60.0, 0.0]
    certainty = expected_certainty(apart, weights, 1.0)
    assert certainty[0] == pytest.approx(0.5)
    assert certainty[1] == pytest.approx(1.0)
    assert certainty[2] == pytest.approx(math.sqrt(0.5))
    # What counts less tells less.
    assert expected_certainty(apart / 30.0, weights, 3.0)[1] < 0.7


def left_open(model, *names):
    """The posterior of a recording if two effects of the catalogue are equally probable, and its errors."""
    others = [name for name in REGISTRY if name not in names]
    before = refit(model, {}, model.neutral)
    weighed = weigh(model, before, covariates(model, before), others, lambda text, share: None)
    model = model.with_bins(weighed.bins)
    before = refit(model, {}, before.nuisance, steps=0)
    search = HypothesisSearch(
        model, before, weighed.scores, weighed.errors, POLICY, others, lambda text, share: None
    )
    starts = {score.id: search.looks.starts_of(score) for score in weighed.scores}
    fitted = tuple(search.hypothesis(search.fit(starts[name], before.nuisance)) for name in names)
    return replace(weighed.posterior, hypotheses=fitted, p=(0.5,) * len(fitted)), weighed.errors


def test_every_effect_has_a_witness():
    assert set(WITNESS) == set(REGISTRY)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "rival", "tells"),
    [
        # How bright the arc is nobody knows so exactly: it takes on what becomes of the exposure.
        ({"laser_power_drift": {"rate_per_s": -0.1}}, "exposure_drift", False),
        # The stripe alone throws a haze as even as an offset; the arc's is much more.
        ({"veiling_glare": {"share": 0.4}}, "black_level", True),
    ],
)
def test_what_tells_two_effects_of_a_dry_run_apart(hidden, rival, tells, tmp_path):
    expected = small_recording(tmp_path / "made", hidden, 3)
    dry = of_stratum(expected, "laser")
    ((name, _),) = hidden.items()
    measurement = next_measurement(dry, *left_open(dry, name, rival), POLICY)
    assert measurement.separates == (name, rival)
    assert measurement.resolves == tells
    if tells:
        assert next(item for item in MENU if item.name == measurement.experiment).arc_on
    else:
        assert measurement.experiment == f"{WITNESS[name]}, as a witness"


def travelling(timestamp_s):
    """A tool that travels along x at 8 mm/s, turned about z by 90 deg."""
    T_base_tool = np.eye(4)
    T_base_tool[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    T_base_tool[:3, 3] = 8.0 * timestamp_s, 0.0, 1.0
    return T_base_tool


@pytest.fixture(scope="module")
def planned():
    """Frames of all experiments, at a dark frame's time and place."""
    setup = nominal_setup("v_groove", "mild_steel", width=48, height=36)
    dark = Condition(0.0, 0.0, 0.001, 1.1)
    nothing = np.zeros((0, 0))
    values = ObservedFrame(0, 11, 1.1, "dark", dark, travelling, (0.0, 0.0, 0.0), *9 * [nothing])
    return {item.key: planned_frame(item, values, setup) for item in MENU}


@pytest.mark.parametrize(
    ("key", "laser_level", "current", "exposure"),
    [
        ("dark", 0.0, 0.0, 1.0),
        ("laser", 1.0, 0.0, 1.0),
        ("arc", 0.0, 1.0, 1.0),
        ("exposure", 1.0, 1.0, 0.5),
        ("current", 1.0, 1.5, 1.0),
        ("raised", 1.0, 1.0, 1.0),
        ("sideways", 1.0, 1.0, 1.0),
        ("along", 1.0, 1.0, 1.0),
        ("faster", 1.0, 1.0, 1.0),
    ],
)
def test_an_experiment_takes_its_light_from_the_setup(planned, key, laser_level, current, exposure):
    setup = nominal_setup("v_groove", "mild_steel", width=48, height=36)
    condition = planned[key].condition
    assert condition.laser_level == laser_level
    assert condition.arc_level == pytest.approx(current**setup.arc.current_exponent)
    assert condition.exposure_s == pytest.approx(exposure * setup.camera.exposure_s)
    assert condition.timestamp_s == 1.1


def test_an_experiment_moves_the_tool_in_its_own_frame(planned):
    cos, sin = math.cos(math.radians(10.0)), math.sin(math.radians(10.0))
    plain = travelling(1.2)
    raised = plain.copy()
    raised[2, 3] = 3.0
    np.testing.assert_allclose(planned["raised"].pose_at(1.2), raised)
    # The tool's x is base's y, its y is base's -x.
    R = np.column_stack([[0.0, 1.0, 0.0], [-cos, 0.0, sin], [sin, 0.0, cos]])
    np.testing.assert_allclose(planned["sideways"].pose_at(1.2)[:3, :3], R, atol=1e-12)
    R = np.column_stack([[0.0, cos, -sin], [-1.0, 0.0, 0.0], [0.0, sin, cos]])
    np.testing.assert_allclose(planned["along"].pose_at(1.2)[:3, :3], R, atol=1e-12)
    for key in ("dark", "laser", "arc", "exposure", "current"):
        np.testing.assert_allclose(planned[key].pose_at(1.2), plain)
    np.testing.assert_allclose(planned["faster"].pose_at(1.1), travelling(1.1))
    np.testing.assert_allclose(planned["faster"].pose_at(1.2), travelling(1.4))


def test_the_menu_is_known_by_key_and_by_what_the_report_says():
    assert len({item.key for item in MENU}) == len({item.name for item in MENU}) == len(MENU)
    assert [item.key for item in MENU if item.name == "the torch raised by 2 mm"] == ["raised"]
    assert [item.key for item in MENU if item.name == "the same run 3 times as fast"] == ["faster"]


@pytest.mark.slow
def test_no_experiment_is_asked_for_that_the_recording_holds(tmp_path):
    """The example has dark frames, laser and arc alone, 100 and 140 A, and two exposures."""
    model = small_recording(tmp_path / "made", {"veiling_glare": {"share": 0.1}})
    observed = model.observed
    recorded = {experiment.key for experiment in MENU if is_recorded(experiment, observed)}
    assert recorded == {"dark", "laser", "arc", "exposure", "current"}
    only = observed.subset(np.array([frame.stratum == "laser" for frame in observed.frames]))
    assert [experiment.key for experiment in MENU if is_recorded(experiment, only)] == ["laser"]
    asked = next_measurement(model, *left_open(model, "veiling_glare", "fume"), POLICY).experiment
    assert asked not in {experiment.name for experiment in MENU if experiment.key in recorded}


def test_where_nothing_is_open_nothing_is_asked_for():
    likely, other = (SimpleNamespace(ids=(name,)) for name in ("gamma", "fume"))
    sure = Posterior(None, (likely, other), None, 0.0, (0.99, 0.01), (0.0, 0.0), 0.0)
    assert next_measurement(None, sure, None, POLICY) is None


def test_beside_something_unknown_a_witness_of_the_only_effect_is_asked_for():
    only = Posterior(None, (SimpleNamespace(ids=("fume",)),), None, 0.0, (0.01,), (0.99,), 0.0)
    asked = next_measurement(None, only, None, POLICY, is_unknown=True)
    assert asked.experiment == f"{WITNESS['fume']}, as a witness"
    assert asked.separates == ("fume",)
    assert not asked.resolves
