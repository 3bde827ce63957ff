"""Which effects are named: what explains a gap, what else is in question, what is looked for beside it."""

from types import SimpleNamespace

import pytest

from noise_model.effects import REGISTRY
from sim_to_real.decision import decide as room
from sim_to_real.decision.decide import decide, open_pair
from sim_to_real.diagnose import ranking
from sim_to_real.diagnosis import Verdict
from sim_to_real.fit.quadratic import N_EFFECTIVE
from sim_to_real.search import stepwise as beside
from sim_to_real.search.hypothesis import likelihood_nats
from sim_to_real.search.single_effects import Search
from tests.sim_to_real.verdicts import hypothesis

PROMISING = SimpleNamespace(id="fume", residual_fraction=0.1, n_parameters=3)
"""An effect that seems to leave a tenth of what others do."""


def decided(
    monkeypatch,
    baseline,
    singles,
    joint,
    seen=0.0,
    scores=("a score",),
    again=None,
    expensive=None,
    trends=None,
    rescored=(PROMISING,),
    flicker=None,
    indistinguishable=(),
):
    """Decide between given fits; `seen` is the misfit of all in pixels, or of each by its effects.

    `again` is the likeliest one converged, `expensive` are the fits with expensive effects, `trends`
    those with trends, `rescored` the scores beside the best one, `flicker` that of arc_flicker there, and
    `indistinguishable` the pairs that look the same.
    """
    misfits = seen if isinstance(seen, dict) else {}
    answers = {"score_catalogue": scores, "fit_single_effects": singles}
    answers |= {"with_expensive": expensive or singles, "with_trends": trends or singles}
    for name, answer in answers.items():
        monkeypatch.setattr(room, name, lambda *_, answer=answer: answer)
    beside_best = [*rescored, flicker] if flicker else rescored
    for name, answer in {"stepwise": joint, "rescored": beside_best, "_pairs": ()}.items():
        monkeypatch.setattr(beside, name, lambda *_, answer=answer: answer)
    monkeypatch.setattr(beside, "with_flicker", lambda _, __, scores: scores)
    monkeypatch.setattr(room, "projected_signatures", lambda *_: {})
    monkeypatch.setattr(room, "not_resolvable", lambda _: indistinguishable)
    monkeypatch.setattr(room, "refit", lambda *_, **__: None)
    monkeypatch.setattr(room, "told_apart_by_pixels", lambda _, hypotheses, baseline: (hypotheses, baseline))
    monkeypatch.setattr(room, "_converged", lambda _, hypothesis: again or hypothesis)
    model = SimpleNamespace(
        take_tangents=lambda *_: None,
        neutral=None,
        lights=lambda *_: [],
        residuals=lambda _: baseline.refit.residuals,
        stated_values=lambda name: REGISTRY[name].neutral,
    )
    search = Search(model, (), lambda fits: [misfits.get(fit.ids, seen) for fit in fits], print)
    return decide(search, baseline)


def test_one_that_is_enough_beside_likelier_ones_is_ambiguous_with_them(monkeypatch):
    singles = [hypothesis("fume", mean_square=2.5), hypothesis("dirty_window", mean_square=2.51)]
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), singles, hypothesis("gamma", mean_square=1.05)
    )
    assert decision.verdict is Verdict.AMBIGUOUS
    assert decision.chosen.ids == ("gamma",)
    assert decision.ambiguous == (("gamma", "fume", "dirty_window"),)


def test_how_sure_one_is_of_what_is_named_is_a_probability_of_that(monkeypatch):
    singles = [hypothesis("fume", mean_square=2.5), hypothesis("gamma", mean_square=2.51)]
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), singles, hypothesis("fume", "gamma", mean_square=1.05)
    )
    assert decision.verdict is Verdict.EFFECTS
    assert decision.posterior_probability > 0.99 > decision.posterior_probabilities[0] > 0.5
    assert decision.posterior_probabilities.sum() == pytest.approx(1.0)
    alike = [hypothesis("fume", mean_square=1.0), hypothesis("gamma", mean_square=1.01)]
    # Their likelihoods are as 1 to 1.01^-(N / 2), and nothing else is likely.
    even = 1.0 / (1.0 + 1.01 ** (-0.5 * N_EFFECTIVE))
    assert decided(
        monkeypatch, hypothesis(mean_square=9.0), alike, None
    ).posterior_probability == pytest.approx(even, abs=0.01)


@pytest.mark.parametrize(
    ("seen", "mean_square", "verdict"),
    [(0.5, 0.9, Verdict.NO_GAP), (1.2, 0.9, Verdict.EFFECTS), (0.5, 0.8, Verdict.EFFECTS)],
)
def test_a_gap_below_the_floor_must_show_in_pixels_or_be_beyond_chance(
    monkeypatch, seen, mean_square, verdict
):
    """Of 26 effects one is better by ln 26 = 3.3 nats by chance: 5.4 are not enough, 17 are."""
    names = [f"a look at {n}" for n in range(26)]
    decision = decided(
        monkeypatch,
        hypothesis(mean_square=0.95),
        [hypothesis("gamma", mean_square=mean_square)],
        None,
        seen,
        names,
    )
    assert decision.verdict is verdict


@pytest.mark.parametrize(("seen", "verdict"), [(0.6, Verdict.NO_GAP), (3.0, Verdict.EFFECTS)])
def test_light_that_bounces_is_tried_where_only_pixels_show_a_gap(monkeypatch, seen, verdict):
    bounced = hypothesis("interreflection", mean_square=0.6)
    mean_square = {(): seen, ("interreflection",): 0.4}
    singles = [hypothesis("arc_length", mean_square=0.65)]
    decision = decided(
        monkeypatch, hypothesis(mean_square=0.66), singles, None, mean_square, expensive=[bounced, *singles]
    )
    assert decision.verdict is verdict
    assert decision.chosen.ids == (bounced.ids if verdict is Verdict.EFFECTS else ())


@pytest.mark.parametrize(
    ("mean_square", "verdict", "ambiguous"),
    [(1.09, Verdict.AMBIGUOUS, (("fume", "dirty_window"),)), (1.11, Verdict.EFFECTS, ())],
)
def test_what_explains_all_is_a_rival_of_what_is_likelier_and_does_not(
    monkeypatch, mean_square, verdict, ambiguous
):
    rival = hypothesis("dirty_window", mean_square=mean_square)
    rival.evidence = likelihood_nats(1.5) - 9.0
    singles = [hypothesis("fume", mean_square=1.5), rival]
    decision = decided(monkeypatch, hypothesis(mean_square=9.0), singles, None)
    assert (decision.verdict, decision.chosen.ids, decision.ambiguous) == (verdict, ("fume",), ambiguous)
    assert decision.posterior_probability == decision.posterior_probabilities[0]
    assert decision.posterior_probability == (
        pytest.approx(0.5, abs=0.01) if ambiguous else pytest.approx(1.0, abs=0.01)
    )
    assert bool(decision.posterior_probabilities[1] == decision.posterior_probabilities[0]) is bool(ambiguous)


@pytest.mark.parametrize(("mean_square", "named"), [(4.9, ("gamma", "fume")), (5.1, ("gamma",))])
def test_another_effect_must_halve_what_pixels_show_beside_one_that_explains_the_bins(
    monkeypatch, mean_square, named
):
    """Of 9 - 1 the pair may leave 4; of bins it has 5 nats more."""
    seen = {("gamma",): 9.0, ("gamma", "fume"): mean_square}
    pair = hypothesis("gamma", "fume", mean_square=0.95)
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), [hypothesis("gamma", mean_square=1.0)], pair, seen
    )
    assert (decision.verdict, decision.chosen.ids) == (Verdict.EFFECTS, named)
    seen[("gamma",)] = 1.4
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), [hypothesis("gamma", mean_square=1.0)], pair, seen
    )
    assert decision.chosen.ids == ("gamma",)


@pytest.mark.parametrize(("mean_square", "named"), [(0.9, ("gamma", "fume")), (0.91, ("gamma",))])
def test_much_evidence_of_its_own_names_another_beside_one_that_leaves_nothing(
    monkeypatch, mean_square, named
):
    """Of 200 residuals' likelihood ln(1 / 0.9) is 10.5 nats, ln(1 / 0.91) 9.4."""
    pair = hypothesis("gamma", "fume", mean_square=mean_square)
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), [hypothesis("gamma", mean_square=1.0)], pair, 0.5
    )
    assert (decision.verdict, decision.chosen.ids) == (Verdict.EFFECTS, named)


def test_what_pixels_show_of_a_fit_that_had_not_settled_is_no_other_effect(monkeypatch):
    """The first fit leaves 9 in pixels, which a second effect would explain; settled it leaves 1."""
    settled = hypothesis("gamma", mean_square=0.97)
    settled.pixel_misfit = 1.0
    pair = hypothesis("gamma", "fume", mean_square=0.95)
    seen = {("gamma",): 9.0, ("gamma", "fume"): 1.0}
    singles = [hypothesis("gamma", mean_square=1.0)]
    decision = decided(monkeypatch, hypothesis(mean_square=9.0), singles, pair, seen, again=settled)
    assert decision.chosen is settled
    assert decided(monkeypatch, hypothesis(mean_square=9.0), singles, pair, seen).chosen is pair


def test_levels_of_single_frames_do_not_hide_what_grows_from_frame_to_frame(monkeypatch):
    singles = [hypothesis("arc_flicker", mean_square=0.8), hypothesis("arc_deflection", mean_square=1.25)]
    grows = hypothesis("arc_deflection", mean_square=0.66)
    decision = decided(monkeypatch, hypothesis(mean_square=1.9), singles, None, trends=[grows, singles[0]])
    assert (decision.verdict, decision.chosen.ids) == (Verdict.EFFECTS, grows.ids)
    assert decided(monkeypatch, hypothesis(mean_square=1.9), singles, None).chosen.ids == ("arc_flicker",)
    # Beside what explains the gap by itself nothing is made to grow.
    singles[0] = hypothesis("gamma", mean_square=0.8)
    decision = decided(monkeypatch, hypothesis(mean_square=1.9), singles, None, trends=[grows, singles[0]])
    assert decision.chosen.ids == ("gamma",)


def test_a_trifle_is_not_named_beside_what_leaves_nothing(monkeypatch):
    """35 nats are what the first one's form leaves."""
    pair = hypothesis("gamma", "fume", mean_square=0.7)
    singles = [hypothesis("gamma", mean_square=1.0)]
    assert decided(monkeypatch, hypothesis(mean_square=9.0), singles, pair, 0.5).chosen is pair
    pair.refit.effects["fume"] = {**REGISTRY["fume"].neutral, "extinction_per_m": 0.01}
    assert decided(monkeypatch, hypothesis(mean_square=9.0), singles, pair, 0.5).chosen.ids == ("gamma",)


def test_what_pixels_say_against_one_effect_is_no_evidence_of_another_s_own(monkeypatch):
    """In bins the pair has 7.3 nats more."""
    best, pair = hypothesis("gamma", mean_square=1.0), hypothesis("gamma", "fume", mean_square=0.93)
    best.evidence -= 4.0
    assert decided(monkeypatch, hypothesis(mean_square=9.0), [best], pair, 0.5).chosen.ids == ("gamma",)


@pytest.mark.parametrize(("mean_square", "named"), [(0.92, ("gamma",)), (0.91, ("gamma", "defocus"))])
def test_what_seems_to_gain_little_is_not_fitted_beside_what_leaves_nothing(monkeypatch, mean_square, named):
    """One parameter costs 2.6 nats: 8 % less left seems to gain 5.7, 9 % less 6.8."""
    best, pair = hypothesis("gamma", mean_square=1.0), hypothesis("gamma", "defocus", mean_square=0.8)
    best.refit.mean_square = 1.0
    look = SimpleNamespace(id="defocus", residual_fraction=mean_square, n_parameters=1)
    decision = decided(monkeypatch, hypothesis(mean_square=9.0), [best], pair, 0.5, rescored=[look])
    assert decision.chosen.ids == named
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), [best], pair, 0.5, rescored=[look], flicker=PROMISING
    )
    assert decision.chosen.ids == pair.ids


@pytest.mark.parametrize(("lead", "verdict"), [(0.9, Verdict.EFFECTS), (0.6, Verdict.UNKNOWN)])
def test_what_is_held_back_does_not_stand_before_what_explains_as_much(monkeypatch, lead, verdict):
    """Of 0.909 and 0.9 either is as good; of 0.909 and 0.6 what is held back leads by 41 nats."""
    free, held_back = (
        hypothesis("veiling_glare", mean_square=0.909),
        hypothesis("dirty_window", mean_square=lead),
    )
    held_back.is_bound_limited = True
    decision = decided(monkeypatch, hypothesis(mean_square=9.0), [held_back, free], None)
    assert decision.verdict is verdict
    # Of what is no explanation the likeliest comes first all the same.
    assert decision.posterior_probabilities[0] > 0.99
    if verdict is Verdict.EFFECTS:
        assert decision.chosen.ids == free.ids
        assert decision.posterior_probability > 0.99
        # Nor is it one of two that cannot be told apart.
        other_way = [
            hypothesis("veiling_glare", mean_square=0.9),
            hypothesis("dirty_window", mean_square=0.909),
        ]
        other_way[1].is_bound_limited = True
        assert decided(monkeypatch, hypothesis(mean_square=9.0), other_way, None).verdict is Verdict.EFFECTS


@pytest.mark.parametrize(("mean_square", "verdict"), [(1.9, Verdict.UNKNOWN), (2.1, Verdict.EFFECTS)])
def test_nothing_is_looked_for_beside_a_mimic_of_almost_all(monkeypatch, mean_square, verdict):
    """Of a gap of 8 it leaves 0.9 or 1.1: 11 or 14 %."""
    mimic, pair = (
        hypothesis("dirty_window", mean_square=mean_square),
        hypothesis("dirty_window", "fume", mean_square=1.0),
    )
    mimic.is_bound_limited = True
    assert decided(monkeypatch, hypothesis(mean_square=9.0), [mimic], pair).verdict is verdict


def test_what_its_bounds_hold_back_explains_nothing(monkeypatch):
    held_back = hypothesis("dirty_window", mean_square=0.9)
    assert decided(monkeypatch, hypothesis(mean_square=9.0), [held_back], None).verdict is Verdict.EFFECTS
    held_back.is_bound_limited = True
    assert decided(monkeypatch, hypothesis(mean_square=9.0), [held_back], None).verdict is Verdict.UNKNOWN


@pytest.mark.parametrize(
    ("mean_square", "alike", "verdict"),
    [
        (0.8, [("black_level", "veiling_glare")], Verdict.AMBIGUOUS),
        (0.8, [("black_level", "fume")], Verdict.EFFECTS),
        (0.85, [("black_level", "veiling_glare")], Verdict.EFFECTS),
    ],
)
def test_the_price_alone_tells_no_pair_apart_that_looks_the_same(monkeypatch, mean_square, alike, verdict):
    """Of 0.8 and 0.85 the first is likelier by 6 nats; the second effect's further parameter costs 2.6."""
    first, second = (
        hypothesis("black_level", mean_square=0.8),
        hypothesis("veiling_glare", mean_square=mean_square),
    )
    second.evidence -= 2.7
    decision = decided(
        monkeypatch, hypothesis(mean_square=9.0), [first, second], None, indistinguishable=alike
    )
    assert decision.verdict is verdict
    assert decision.chosen.ids == first.ids
    if verdict is Verdict.AMBIGUOUS:
        assert decision.ambiguous == (("black_level", "veiling_glare"),)


def test_what_is_to_be_told_apart_is_what_is_in_question(monkeypatch):
    fume, gamma, window = (hypothesis(name) for name in ("fume", "gamma", "dirty_window"))

    def pair(verdict, *ambiguous, alike=(), named=("fume",)):
        singles, chosen = (fume, gamma, window), SimpleNamespace(ids=named)
        return open_pair(
            SimpleNamespace(
                verdict=verdict, singles=singles, ambiguous=ambiguous, indistinguishable=alike, chosen=chosen
            )
        )

    assert pair(Verdict.AMBIGUOUS, ("fume", "dirty_window")) == (fume, window)
    assert pair(Verdict.UNKNOWN) == (fume, gamma)
    assert pair(Verdict.NO_GAP) is None
    assert pair(Verdict.EFFECTS) is None
    assert pair(Verdict.EFFECTS, alike=[("gamma", "dirty_window")]) is None
    assert pair(Verdict.EFFECTS, alike=[("dirty_window", "fume")]) == (fume, window)
    # Neither what only looks likeliest nor what is named beside it is in question.
    every = [("fume", "gamma"), ("fume", "dirty_window"), ("gamma", "dirty_window")]
    assert pair(Verdict.EFFECTS, alike=every, named=()) is None
    assert pair(Verdict.EFFECTS, alike=every, named=("gamma", "black_level")) == (gamma, fume)
    assert pair(Verdict.EFFECTS, alike=every, named=("gamma", "fume")) == (fume, window)


def test_the_ranking_keeps_a_mimic_behind_what_explains_all():
    """Though it is likelier: its bounds hold it back. What scatters stands where its evidence does."""
    held_back = hypothesis("dirty_window", mean_square=1.2)
    held_back.is_bound_limited = True
    singles = [hypothesis("veiling_glare", mean_square=1.22), held_back, hypothesis("fume", mean_square=3.0)]
    baseline = hypothesis(mean_square=4.0)
    decision = SimpleNamespace(singles=singles, posterior_probabilities=[0.5, 0.4, 0.0])
    between = likelihood_nats(2.0) - baseline.evidence
    random = SimpleNamespace(
        evidence={"speckle": between}, confidence={"speckle": 1.0}, closed={"speckle": 0.3}
    )
    ranked = ranking(decision, baseline, random)
    assert [item.id for item in ranked] == ["veiling_glare", "dirty_window", "speckle", "fume"]
    assert ranked[1].is_bound_limited
