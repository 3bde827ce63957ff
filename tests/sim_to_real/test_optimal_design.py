"""What looks the same, the least that shows, and what an experiment would show."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from noise_model.condition import Condition
from noise_model.effects import REGISTRY
from noise_model.fit import Parameter
from sim_to_real.data.binned import ObservedFrame
from sim_to_real.decision.experiments import BY_NAME, MENU, WITNESS
from sim_to_real.decision.optimal_design import best_measurement, is_recorded, planned_frame, with_experiment
from sim_to_real.fit.gauss_newton import FRAME_LEVEL, refit
from sim_to_real.fit.quadratic import N_EFFECTIVE, Quadratic
from sim_to_real.search.identifiability import not_resolvable, projected_signatures, smallest_detectable
from sim_to_real.search.score_test import ScoreTest
from tests.sim_to_real.small import small_recording

N = 400
RNG = np.random.default_rng(7)
A, B, C, NUISANCE = RNG.standard_normal((4, N))


def screened(name, *columns):
    """Looked at one place each, half a unit of the first parameter away."""
    return ScoreTest(name, 1.0, {}, np.column_stack(columns), {}, np.full((len(columns), 1), 0.5))


def baseline(jacobian):
    parameters = tuple(Parameter(f"n{i}", "", 0.0) for i in range(jacobian.shape[1]))
    return SimpleNamespace(quadratic=SimpleNamespace(parameters=parameters), jacobian=jacobian)


def test_nuisances_are_projected_out():
    signatures = projected_signatures(
        baseline(NUISANCE[:, None]), [screened("arc_length", A + 50.0 * NUISANCE)]
    )
    assert abs(signatures["arc_length"][:N, 0] @ NUISANCE) < 1e-6 * N
    expected = A - NUISANCE * (A @ NUISANCE) / (NUISANCE @ NUISANCE)
    np.testing.assert_allclose(signatures["arc_length"][:N, 0], expected, atol=1e-6)


def test_effects_that_a_nuisance_makes_alike_are_a_pair():
    looked = [
        screened("arc_length", A),
        screened("arc_radius", -2.0 * A + 30.0 * NUISANCE),
        screened("gamma", B),
    ]
    signatures = projected_signatures(baseline(NUISANCE[:, None]), looked)
    assert not_resolvable(signatures) == (("arc_length", "arc_radius"),)


def test_one_that_lies_within_the_span_of_another_cannot_be_told_from_it():
    looked = [screened("arc_length", A + B), screened("hand_eye", A, B), screened("gamma", C)]
    signatures = projected_signatures(baseline(NUISANCE[:, None]), looked)
    assert not_resolvable(signatures) == (("arc_length", "hand_eye"),)


def test_the_least_that_shows_outweighs_what_its_parameter_costs():
    item = screened("arc_length", A)
    signatures = projected_signatures(baseline(np.zeros((N, 1))), [item])
    least = smallest_detectable(signatures, [item])["arc_length"]
    added = (least.value / 0.5) ** 2 * float(A @ A) / N
    assert 0.5 * N_EFFECTIVE * math.log1p(added) == pytest.approx(3.0 + 0.5 * math.log(N_EFFECTIVE))
    assert least.unit == "mm"


def test_frames_to_come_count_as_often_as_they_are_taken_and_have_levels_of_their_own():
    draw = np.random.default_rng(3)
    seen_J, more_J = draw.standard_normal((40, 3)), draw.standard_normal((20, 4))
    seen_r, more_r = draw.standard_normal(40), draw.standard_normal(20)
    more_J[:10, 3] = more_J[10:, 2] = 0.0
    names = ("a", "b", f"{FRAME_LEVEL}0"), ("a", "b", f"{FRAME_LEVEL}0", f"{FRAME_LEVEL}1")
    values = [tuple(Parameter(name, "", 0.0) for name in some) for some in names]
    seen = Quadratic.of(values[0], np.zeros(3), seen_r, seen_J, np.ones(40), np.array([40]))
    more = Quadratic.of(values[1], np.zeros(4), more_r, more_J, np.ones(20), np.array([10, 10]))
    both = with_experiment(seen, more, 1, 3)
    J = np.zeros((70, 5))
    J[:40, :3] = seen_J
    J[40:, [0, 1, 3, 4]] = np.tile(more_J[10:], (3, 1))
    r = np.concatenate([seen_r, np.tile(more_r[10:], 3)])
    x = np.linalg.lstsq(J, -r, rcond=None)[0]
    assert both.mean_square(x) == pytest.approx(np.mean((r + J @ x) ** 2))
    np.testing.assert_allclose(both.costs(x), [np.sum(part**2) for part in np.split(r + J @ x, [40])])


def test_every_effect_has_a_witness():
    assert set(WITNESS) == set(REGISTRY)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "rival", "tells"),
    [
        # How bright the arc is nobody knows so exactly: it takes on what becomes of the exposure.
        ({"laser_power_drift": {"rate_per_s": -0.1}}, "exposure_drift", False),
        # The stripe alone throws a haze as even as an offset; the arc's is much more.
        ({"veiling_glare": {"share": 0.1}}, "black_level", True),
    ],
)
def test_what_tells_two_effects_of_a_dry_run_apart(hidden, rival, tells, tmp_path):
    expected = small_recording(tmp_path / "made", hidden)
    dry = expected.subset(np.array([frame.stratum == "laser" for frame in expected.observed.frames]))
    ((name, values),) = hidden.items()
    fits = [
        refit(dry, {id: given}, dry.neutral)
        for id, given in ((name, values), (rival, REGISTRY[rival].typical))
    ]
    measurement = best_measurement(dry, *fits)
    assert measurement.separates == (name, rival)
    assert measurement.resolves == tells
    if tells:
        assert BY_NAME[measurement.experiment].arc_on
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
    values = ObservedFrame(0, 11, 1.1, "dark", dark, travelling, (0.0, 0.0, 0.0), *8 * [nothing])
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
    assert len({item.key for item in MENU}) == len(MENU) == len(BY_NAME)
    assert BY_NAME["the torch raised by 2 mm"].key == "raised"
    assert BY_NAME["the same run 3 times as fast"].key == "faster"


@pytest.mark.slow
def test_no_experiment_is_asked_for_that_the_recording_holds(tmp_path):
    """The example has dark frames, laser and arc alone, 100 and 140 A, and two exposures."""
    model = small_recording(tmp_path / "made", {"veiling_glare": {"share": 0.1}})
    observed = model.observed
    recorded = {experiment.key for experiment in MENU if is_recorded(experiment, observed)}
    assert recorded == {"dark", "laser", "arc", "exposure", "current"}
    only = observed.subset(np.array([frame.stratum == "laser" for frame in observed.frames]))
    assert [experiment.key for experiment in MENU if is_recorded(experiment, only)] == ["laser"]
    fits = [refit(model, {name: REGISTRY[name].typical}, model.neutral) for name in ("veiling_glare", "fume")]
    experiment = BY_NAME.get(best_measurement(model, *fits).experiment)
    assert experiment is None or experiment.key not in recorded
