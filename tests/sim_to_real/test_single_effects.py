"""Candidates that bins find alike are told apart by pixels; derivatives are followed from step to step."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from noise_model.effects import REGISTRY
from noise_model.fit import Parameter
from sim_to_real.decision.holdout_gap import pixel_misfits
from sim_to_real.fit.gauss_newton import broyden_update, refit
from sim_to_real.fit.nuisances import SEAM_FROM
from sim_to_real.fit.quadratic import Quadratic
from sim_to_real.search import single_effects as select
from sim_to_real.search.hypothesis import (
    Hypothesis,
    cross_validated,
    is_explained,
    likelihood_nats,
    mean_square_beyond_form,
)
from sim_to_real.search.single_effects import INDISTINGUISHABLE_NATS, Search, told_apart_by_pixels
from tests.sim_to_real.small import small_recording
from tests.sim_to_real.verdicts import seen


def hypothesis(name, mean_square, n_parameters=1):
    fit = SimpleNamespace(
        residuals=np.full(50, math.sqrt(mean_square)),
        nuisance=None,
        ids=(name,),
        x=np.zeros(n_parameters),
        n_nuisances=0,
        n_parameters=n_parameters,
        mean_square=mean_square,
        quadratic=quadratic(np.zeros((50, n_parameters)), np.full(50, math.sqrt(mean_square))),
    )
    return Hypothesis(fit, np.array([50.0 * mean_square]))


def quadratic(J, r, upper=np.inf):
    """The cost about 0 of parameters that may be as low as -2."""
    parameters = [Parameter(f"p{n}", "", -1.0, 1e3, -2.0, upper, 0.1) for n in range(J.shape[1])]
    x = np.zeros(J.shape[1])
    return Quadratic.of(parameters, x, r, J, np.ones(len(r)), np.array([len(r)]))


def test_a_seam_that_one_frame_alone_sees_is_not_foretold_from_the_others():
    """Its first mode is seen in the first frame only, whose pull on it the prior would undo."""
    n_frames, n_bins, seam = 10, 30, SEAM_FROM
    rng = np.random.default_rng(0)
    parameters = tuple(Parameter(f"p{n}", "", 0.0, 1.0, -30.0, 30.0, 0.1) for n in range(seam + 1))
    J = rng.standard_normal((n_frames * n_bins, seam + 1))
    J[n_bins:, seam] = 0.0
    x = np.zeros(seam + 1)
    x[seam] = 5.0
    r, counts = 0.5 * rng.standard_normal(len(J)), np.full(n_frames, n_bins)
    cost = Quadratic.of(parameters, x, r, J, np.ones(len(r)), counts)
    fitted = SimpleNamespace(
        ids=(), x=x, n_nuisances=seam + 1, residuals=r, jacobian=J, weights=np.ones(len(r)), quadratic=cost
    )
    expected = SimpleNamespace(observed=seen(["both"] * n_frames))
    foretold = cost.solve(np.arange(n_frames) > 0)
    assert cost.costs(foretold)[0] > 3.0 * cost.chi2[0]
    assert cross_validated(expected, fitted).costs[0] < 1.5 * cost.chi2[0]


def test_a_frame_that_alone_shows_the_arc_is_judged_by_the_fit_that_saw_it():
    """Its level is known by a tolerance alone without it, and a tolerance is no prediction."""
    rng, n_bins = np.random.default_rng(2), 60
    kinds = ["laser"] * 5 + ["both"]
    parameters = tuple(Parameter(f"p{n}", "", 0.0, 1.0, -30.0, 30.0, 0.1) for n in range(SEAM_FROM))
    J = np.zeros((len(kinds) * n_bins, len(parameters)))
    J[-n_bins:, 0] = 1.0
    r, counts = 0.5 * rng.standard_normal(len(J)), np.full(len(kinds), n_bins)
    x = np.zeros(len(parameters))
    x[0] = 5.0
    cost = Quadratic.of(parameters, x, r, J, np.ones(len(r)), counts)
    fitted = SimpleNamespace(ids=(), x=x, n_nuisances=SEAM_FROM, residuals=r, jacobian=J, quadratic=cost)
    alone = cross_validated(SimpleNamespace(observed=seen(kinds)), fitted)
    assert alone.costs[-1] == pytest.approx(float(r[-n_bins:] @ r[-n_bins:]))
    # As if another frame had shown it too: then this one is foretold, badly.
    beside = cross_validated(SimpleNamespace(observed=seen(["both", *kinds[1:]])), fitted)
    assert beside.costs[-1] > 3.0 * alone.costs[-1]


def test_a_single_frame_is_judged_by_the_fit_that_saw_it():
    rng = np.random.default_rng(1)
    r = 20.0 + rng.standard_normal(300)
    cost = quadratic(np.ones((300, SEAM_FROM)), r)
    fitted = SimpleNamespace(
        ids=(),
        x=np.zeros(SEAM_FROM),
        n_nuisances=SEAM_FROM,
        residuals=r,
        jacobian=np.ones((300, SEAM_FROM)),
        quadratic=cost,
    )
    expected = SimpleNamespace(observed=seen(["both"]))
    # The loss is held, so that no bin counts for all.
    assert cross_validated(expected, fitted).cv_mean_square > 5.0


@pytest.mark.slow
def test_of_the_arcs_levels_those_about_their_mean_in_frames_that_show_it_are_parameters(tmp_path):
    expected = small_recording(tmp_path / "flickers", {"arc_flicker": {"sigma_rel": 0.1}})
    flicker = {"arc_flicker": {"sigma_rel": 0.0}}
    fitted = refit(expected, flicker, expected.neutral)
    n_lit = int(expected.observed.lit.sum())
    assert 2 < n_lit < len(expected.observed.frames)
    assert fitted.n_parameters == n_lit - 1
    with_gamma = refit(expected, {**flicker, "gamma": {"gamma": 1.0}}, expected.neutral)
    assert with_gamma.n_parameters == n_lit - 1 + len(REGISTRY["gamma"].parameters)


def ids(result):
    return [item.ids[0] for item in result]


BASELINE = hypothesis("", 5.0, 0)


def pixels(**mean_square):
    """A search in which pixels say what fits leave, of the baseline 20; and of which they were asked."""
    asked, mean_square = [], {"": 20.0, **mean_square}

    def in_pixels(fits):
        asked.append([fit.ids[0] for fit in fits])
        return np.array([mean_square[fit.ids[0]] for fit in fits])

    return Search(None, (), in_pixels, print), asked


def test_pixels_decide_between_what_bins_find_alike():
    search, asked = pixels(drift=4.0, defocus=0.8)
    alike = [hypothesis("drift", 1.00), hypothesis("defocus", 1.05)]
    result, baseline = told_apart_by_pixels(search, [*alike, hypothesis("gamma", 9.0)], BASELINE)
    assert asked == [["", "drift", "defocus"]]
    assert baseline.pixel_misfit == 20.0
    assert ids(result) == ["defocus", "drift", "gamma"]
    assert result[0].evidence - result[1].evidence == pytest.approx(
        -likelihood_nats(4.0) + likelihood_nats(1.05) - likelihood_nats(1.00)
    )


def test_where_nothing_explains_the_bins_pixels_are_asked_of_the_first_ones():
    search, asked = pixels(gamma=4.0, defocus=0.8)
    result, _ = told_apart_by_pixels(search, [hypothesis("gamma", 1.5), hypothesis("defocus", 2.2)], BASELINE)
    assert hypothesis("gamma", 1.5).evidence - hypothesis("defocus", 2.2).evidence > INDISTINGUISHABLE_NATS
    assert asked == [["", "gamma", "defocus"]]
    assert ids(result) == ["defocus", "gamma"]


def test_pixels_are_not_asked_where_one_explains_all_and_none_is_like_it():
    search, asked = pixels(gamma=1.0)
    result, baseline = told_apart_by_pixels(
        search, [hypothesis("gamma", 1.0), hypothesis("fume", 9.0)], BASELINE
    )
    assert asked == []
    assert math.isnan(result[0].pixel_misfit)
    assert baseline is BASELINE
    assert hypothesis("fume", 9.0).evidence < hypothesis("gamma", 1.0).evidence - INDISTINGUISHABLE_NATS


def test_what_an_effect_changes_is_known_to_a_tenth():
    result = hypothesis("gamma", 4.0)
    # Each residual shrinks from 12 to 2, and the change of 10 has a sigma of 1 beside the noise's 1.
    large = SimpleNamespace(lights=lambda *_: [], residuals=lambda _: np.full(50, 12.0))
    assert mean_square_beyond_form(large, result) == pytest.approx(4.0 / 2.0)
    assert is_explained(large, result, hypothesis("", 144.0))
    # The same is left of a gap that was hardly larger: the form is no excuse.
    small = SimpleNamespace(lights=lambda *_: [], residuals=lambda _: np.full(50, 3.0))
    assert not is_explained(small, result, hypothesis("", 9.0))


def test_what_leaves_hardly_anything_of_what_pixels_show_explains_a_gap():
    unmoved = SimpleNamespace(lights=lambda *_: [], residuals=lambda _: np.full(50, math.sqrt(2.0)))
    for shown, mean_square, is_enough in ((20.0, 1.9, True), (20.0, 2.1, False), (1.3, 0.9, False)):
        search, _ = pixels(**{"": shown, "blooming": mean_square})
        (result,), baseline = told_apart_by_pixels(search, [hypothesis("blooming", 2.0)], BASELINE)
        assert is_explained(unmoved, result, baseline) is is_enough


def test_what_pixels_do_not_show_halved_explains_no_gap():
    large = SimpleNamespace(lights=lambda *_: [], residuals=lambda _: np.full(50, 12.0))
    for mean_square, is_enough in ((10.4, True), (10.6, False)):
        search, _ = pixels(arc_radius=mean_square)
        (result,), baseline = told_apart_by_pixels(search, [hypothesis("arc_radius", 1.2)], BASELINE)
        assert is_explained(large, result, baseline) is is_enough


def test_what_bounds_hold_back_is_what_would_be_gained_without_them():
    J = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    r = np.array([-3.0, 4.0, 2.0])

    def held_back(upper, n_nuisances=0):
        fit = SimpleNamespace(
            ids=("dirty_window",), x=np.zeros(2), n_nuisances=n_nuisances, mean_square=29.0 / 3.0
        )
        fit.quadratic = quadratic(J, r, upper)
        return Hypothesis(fit, np.array([29.0])).gain_beyond_bounds_nats

    # The first would go on to 3, the second back to -4 and no farther than to its own bound.
    assert held_back(1.0) == 0.0
    assert held_back(0.0) == pytest.approx(likelihood_nats(4.0 / 3.0) - likelihood_nats(29.0 / 3.0), abs=1e-3)
    assert held_back(0.0, n_nuisances=2) == 0.0


def test_followed_derivatives_tell_what_the_step_did_and_leave_the_rest():
    rng = np.random.default_rng(3)
    J, step = rng.standard_normal((40, 3)), np.array([0.3, 0.0, 0.0])
    change = J @ step + rng.standard_normal(40)
    after = broyden_update(J, step, change)
    np.testing.assert_allclose(after @ step, change)
    np.testing.assert_array_equal(after[:, 1:], J[:, 1:])
    np.testing.assert_array_equal(broyden_update(J, np.zeros(3), change), J)


def test_followed_derivatives_do_not_depend_on_units():
    rng = np.random.default_rng(4)
    J, step, change = rng.standard_normal((40, 3)), rng.standard_normal(3), rng.standard_normal(40)
    units = np.array([1e-3, 1.0, 1e4])
    np.testing.assert_allclose(
        broyden_update(J * units, step / units, change) / units, broyden_update(J, step, change)
    )


@pytest.mark.slow
def test_in_pixels_the_right_effect_leaves_little_of_what_the_baseline_does(tmp_path):
    expected = small_recording(tmp_path / "recording", {"gamma": {"gamma": 1.3}}, coarser=3)
    without = refit(expected, {}, expected.neutral)
    with_it = refit(expected, {"gamma": {"gamma": 1.2}}, expected.neutral)
    of_gap, of_right = pixel_misfits(expected.observed, expected, [without, with_it], {})
    assert 100.0 * of_right < of_gap


@pytest.mark.parametrize(
    ("before", "after", "is_worth_it"),
    [(5.0, 1.0, True), (5.0, 4.0, False), (1.5, 0.4, True), (0.93, 0.8, True), (0.93, 0.85, False)],
)
def test_what_is_dear_is_fitted_where_it_closes_a_good_part_in_a_few_frames(
    monkeypatch, before, after, is_worth_it
):
    """Of a few frames the nuisances may leave less than the floor: then it counts from the least."""
    few = SimpleNamespace()
    expected = SimpleNamespace(observed=seen(["both"] * 8), subset=lambda chosen: few)
    mean_square = {frozenset(): before, frozenset({"interreflection"}): after}
    monkeypatch.setattr(
        select, "refit_from", lambda *values: SimpleNamespace(mean_square=mean_square[frozenset(values[-1])])
    )
    baseline = SimpleNamespace(effects={})
    assert select._closes_enough_in_few(expected, baseline, {"interreflection": {}}) is is_worth_it
