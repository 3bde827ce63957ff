"""Which effects are named: what explains a gap, what else is in question, what is looked for beside it."""

from types import SimpleNamespace

import pytest

from noise_model.effects import REGISTRY
from sim_to_real.decision import decide as room
from sim_to_real.decision.decide import decide, in_question
from sim_to_real.diagnose import ranking
from sim_to_real.diagnosis import Verdict
from sim_to_real.fit.quadratic import N_EFFECTIVE
from sim_to_real.search import stepwise as beside
from sim_to_real.search.hypothesis import likelihood_nats
from sim_to_real.search.single_effects import Search
from tests.sim_to_real.verdicts import candidate

PROMISING = SimpleNamespace(id="fume", left=0.1, n_parameters=3)
"""An effect that seems to leave a tenth of what others do."""


def decided(
    monkeypatch,
    baseline,
    singles,
    several,
    seen=0.0,
    looks=("a look",),
    again=None,
    dear=None,
    changes=None,
    seen_from=(PROMISING,),
    flicker=None,
    alike=(),
):
    """Decide between fits that are handed in; `seen` is what all leave in pixels, or each by its effects.

    `again` is the likeliest one after it has settled, `dear` are the fits with those that take long,
    `changes` those whose size may change from frame to frame, `seen_from` looks from the best one
    and `flicker` that at arc_flicker from there; `alike` are pairs that look the same.
    """
    left = seen if isinstance(seen, dict) else {}
    answers = {"looked": looks, "candidates": singles}
    answers |= {"with_dear": dear or singles, "with_changes": changes or singles}
    for name, answer in answers.items():
        monkeypatch.setattr(room, name, lambda *_, answer=answer: answer)
    looks_on = [*seen_from, flicker] if flicker else seen_from
    for name, answer in {"several": several, "seen_from": looks_on, "_pairs": ()}.items():
        monkeypatch.setattr(beside, name, lambda *_, answer=answer: answer)
    monkeypatch.setattr(beside, "with_flicker", lambda _, __, of: of)
    monkeypatch.setattr(room, "own_signatures", lambda *_: {})
    monkeypatch.setattr(room, "not_resolvable", lambda _: alike)
    monkeypatch.setattr(room, "refit", lambda *_, **__: None)
    monkeypatch.setattr(room, "told_apart", lambda _, found, baseline: (found, baseline))
    monkeypatch.setattr(room, "_again", lambda _, of: again or of)
    expected = SimpleNamespace(
        take_tangents=lambda *_: None,
        neutral=None,
        passed=lambda *_: [],
        residuals=lambda _: baseline.refit.residuals,
        stated=lambda name: REGISTRY[name].neutral,
    )
    search = Search(expected, (), lambda fits: [left.get(fit.ids, seen) for fit in fits], print)
    return decide(search, baseline)


def test_one_that_is_enough_beside_likelier_ones_is_ambiguous_with_them(monkeypatch):
    singles = [candidate("fume", left=2.5), candidate("dirty_window", left=2.51)]
    found = decided(monkeypatch, candidate(left=9.0), singles, candidate("gamma", left=1.05))
    assert found.verdict is Verdict.AMBIGUOUS
    assert found.chosen.ids == ("gamma",)
    assert found.ambiguous == (("gamma", "fume", "dirty_window"),)


def test_how_sure_one_is_of_what_is_named_is_a_probability_of_that(monkeypatch):
    singles = [candidate("fume", left=2.5), candidate("gamma", left=2.51)]
    found = decided(monkeypatch, candidate(left=9.0), singles, candidate("fume", "gamma", left=1.05))
    assert found.verdict is Verdict.EFFECTS
    assert found.sure > 0.99 > found.confidence[0] > 0.5
    assert found.confidence.sum() == pytest.approx(1.0)
    alike = [candidate("fume", left=1.0), candidate("gamma", left=1.01)]
    # Their likelihoods are as 1 to 1.01^-(N / 2), and nothing else is likely.
    even = 1.0 / (1.0 + 1.01 ** (-0.5 * N_EFFECTIVE))
    assert decided(monkeypatch, candidate(left=9.0), alike, None).sure == pytest.approx(even, abs=0.01)


@pytest.mark.parametrize(
    ("seen", "left", "verdict"),
    [(0.5, 0.9, Verdict.NO_GAP), (1.2, 0.9, Verdict.EFFECTS), (0.5, 0.8, Verdict.EFFECTS)],
)
def test_a_gap_below_the_floor_must_show_in_pixels_or_be_beyond_chance(monkeypatch, seen, left, verdict):
    """Of 26 effects one is better by ln 26 = 3.3 nats by chance: 5.4 are not enough, 17 are."""
    names = [f"a look at {n}" for n in range(26)]
    found = decided(monkeypatch, candidate(left=0.95), [candidate("gamma", left=left)], None, seen, names)
    assert found.verdict is verdict


@pytest.mark.parametrize(("seen", "verdict"), [(0.6, Verdict.NO_GAP), (3.0, Verdict.EFFECTS)])
def test_light_that_bounces_is_tried_where_only_pixels_show_a_gap(monkeypatch, seen, verdict):
    bounced = candidate("interreflection", left=0.6)
    left = {(): seen, ("interreflection",): 0.4}
    singles = [candidate("arc_length", left=0.65)]
    found = decided(monkeypatch, candidate(left=0.66), singles, None, left, dear=[bounced, *singles])
    assert found.verdict is verdict
    assert found.chosen.ids == (bounced.ids if verdict is Verdict.EFFECTS else ())


@pytest.mark.parametrize(
    ("left", "verdict", "ambiguous"),
    [(1.09, Verdict.AMBIGUOUS, (("fume", "dirty_window"),)), (1.11, Verdict.EFFECTS, ())],
)
def test_what_explains_all_is_a_rival_of_what_is_likelier_and_does_not(monkeypatch, left, verdict, ambiguous):
    rival = candidate("dirty_window", left=left)
    rival.evidence = likelihood_nats(1.5) - 9.0
    singles = [candidate("fume", left=1.5), rival]
    found = decided(monkeypatch, candidate(left=9.0), singles, None)
    assert (found.verdict, found.chosen.ids, found.ambiguous) == (verdict, ("fume",), ambiguous)
    assert found.sure == found.confidence[0]
    assert found.sure == (pytest.approx(0.5, abs=0.01) if ambiguous else pytest.approx(1.0, abs=0.01))
    assert bool(found.confidence[1] == found.confidence[0]) is bool(ambiguous)


@pytest.mark.parametrize(("left", "named"), [(4.9, ("gamma", "fume")), (5.1, ("gamma",))])
def test_another_effect_must_halve_what_pixels_show_beside_one_that_explains_the_bins(
    monkeypatch, left, named
):
    """Of 9 - 1 the pair may leave 4; of bins it has 5 nats more."""
    seen = {("gamma",): 9.0, ("gamma", "fume"): left}
    pair = candidate("gamma", "fume", left=0.95)
    found = decided(monkeypatch, candidate(left=9.0), [candidate("gamma", left=1.0)], pair, seen)
    assert (found.verdict, found.chosen.ids) == (Verdict.EFFECTS, named)
    seen[("gamma",)] = 1.4
    found = decided(monkeypatch, candidate(left=9.0), [candidate("gamma", left=1.0)], pair, seen)
    assert found.chosen.ids == ("gamma",)


@pytest.mark.parametrize(("left", "named"), [(0.9, ("gamma", "fume")), (0.91, ("gamma",))])
def test_much_evidence_of_its_own_names_another_beside_one_that_leaves_nothing(monkeypatch, left, named):
    """Of 200 residuals' likelihood ln(1 / 0.9) is 10.5 nats, ln(1 / 0.91) 9.4."""
    pair = candidate("gamma", "fume", left=left)
    found = decided(monkeypatch, candidate(left=9.0), [candidate("gamma", left=1.0)], pair, 0.5)
    assert (found.verdict, found.chosen.ids) == (Verdict.EFFECTS, named)


def test_what_pixels_show_of_a_fit_that_had_not_settled_is_no_other_effect(monkeypatch):
    """The first fit leaves 9 in pixels, which a second effect would explain; settled it leaves 1."""
    settled = candidate("gamma", left=0.97)
    settled.left_in_pixels = 1.0
    pair = candidate("gamma", "fume", left=0.95)
    seen = {("gamma",): 9.0, ("gamma", "fume"): 1.0}
    singles = [candidate("gamma", left=1.0)]
    found = decided(monkeypatch, candidate(left=9.0), singles, pair, seen, again=settled)
    assert found.chosen is settled
    assert decided(monkeypatch, candidate(left=9.0), singles, pair, seen).chosen is pair


def test_levels_of_single_frames_do_not_hide_what_grows_from_frame_to_frame(monkeypatch):
    singles = [candidate("arc_flicker", left=0.8), candidate("arc_deflection", left=1.25)]
    grows = candidate("arc_deflection", left=0.66)
    found = decided(monkeypatch, candidate(left=1.9), singles, None, changes=[grows, singles[0]])
    assert (found.verdict, found.chosen.ids) == (Verdict.EFFECTS, grows.ids)
    assert decided(monkeypatch, candidate(left=1.9), singles, None).chosen.ids == ("arc_flicker",)
    # Beside what explains the gap by itself nothing is made to grow.
    singles[0] = candidate("gamma", left=0.8)
    found = decided(monkeypatch, candidate(left=1.9), singles, None, changes=[grows, singles[0]])
    assert found.chosen.ids == ("gamma",)


def test_a_trifle_is_not_named_beside_what_leaves_nothing(monkeypatch):
    """35 nats are what the first one's form leaves."""
    pair = candidate("gamma", "fume", left=0.7)
    singles = [candidate("gamma", left=1.0)]
    assert decided(monkeypatch, candidate(left=9.0), singles, pair, 0.5).chosen is pair
    pair.refit.effects["fume"] = {**REGISTRY["fume"].neutral, "extinction_per_m": 0.01}
    assert decided(monkeypatch, candidate(left=9.0), singles, pair, 0.5).chosen.ids == ("gamma",)


def test_what_pixels_say_against_one_effect_is_no_evidence_of_another_s_own(monkeypatch):
    """In bins the pair has 7.3 nats more."""
    best, pair = candidate("gamma", left=1.0), candidate("gamma", "fume", left=0.93)
    best.evidence -= 4.0
    assert decided(monkeypatch, candidate(left=9.0), [best], pair, 0.5).chosen.ids == ("gamma",)


@pytest.mark.parametrize(("left", "named"), [(0.92, ("gamma",)), (0.91, ("gamma", "defocus"))])
def test_what_seems_to_gain_little_is_not_fitted_beside_what_leaves_nothing(monkeypatch, left, named):
    """One parameter costs 2.6 nats: 8 % less left seems to gain 5.7, 9 % less 6.8."""
    best, pair = candidate("gamma", left=1.0), candidate("gamma", "defocus", left=0.8)
    best.refit.mean_square = 1.0
    look = SimpleNamespace(id="defocus", left=left, n_parameters=1)
    found = decided(monkeypatch, candidate(left=9.0), [best], pair, 0.5, seen_from=[look])
    assert found.chosen.ids == named
    found = decided(monkeypatch, candidate(left=9.0), [best], pair, 0.5, seen_from=[look], flicker=PROMISING)
    assert found.chosen.ids == pair.ids


@pytest.mark.parametrize(("lead", "verdict"), [(0.9, Verdict.EFFECTS), (0.6, Verdict.UNKNOWN)])
def test_what_is_held_back_does_not_stand_before_what_explains_as_much(monkeypatch, lead, verdict):
    """Of 0.909 and 0.9 either is as good; of 0.909 and 0.6 what is held back leads by 41 nats."""
    free, held_back = candidate("veiling_glare", left=0.909), candidate("dirty_window", left=lead)
    held_back.is_held_back = True
    found = decided(monkeypatch, candidate(left=9.0), [held_back, free], None)
    assert found.verdict is verdict
    # Of what is no explanation the likeliest comes first all the same.
    assert found.confidence[0] > 0.99
    if verdict is Verdict.EFFECTS:
        assert found.chosen.ids == free.ids
        assert found.sure > 0.99
        # Nor is it one of two that cannot be told apart.
        other_way = [candidate("veiling_glare", left=0.9), candidate("dirty_window", left=0.909)]
        other_way[1].is_held_back = True
        assert decided(monkeypatch, candidate(left=9.0), other_way, None).verdict is Verdict.EFFECTS


@pytest.mark.parametrize(("left", "verdict"), [(1.9, Verdict.UNKNOWN), (2.1, Verdict.EFFECTS)])
def test_nothing_is_looked_for_beside_a_mimic_of_almost_all(monkeypatch, left, verdict):
    """Of a gap of 8 it leaves 0.9 or 1.1: 11 or 14 %."""
    mimic, pair = candidate("dirty_window", left=left), candidate("dirty_window", "fume", left=1.0)
    mimic.is_held_back = True
    assert decided(monkeypatch, candidate(left=9.0), [mimic], pair).verdict is verdict


def test_what_its_bounds_hold_back_explains_nothing(monkeypatch):
    held_back = candidate("dirty_window", left=0.9)
    assert decided(monkeypatch, candidate(left=9.0), [held_back], None).verdict is Verdict.EFFECTS
    held_back.is_held_back = True
    assert decided(monkeypatch, candidate(left=9.0), [held_back], None).verdict is Verdict.UNKNOWN


@pytest.mark.parametrize(
    ("left", "alike", "verdict"),
    [
        (0.8, [("black_level", "veiling_glare")], Verdict.AMBIGUOUS),
        (0.8, [("black_level", "fume")], Verdict.EFFECTS),
        (0.85, [("black_level", "veiling_glare")], Verdict.EFFECTS),
    ],
)
def test_the_price_alone_tells_no_pair_apart_that_looks_the_same(monkeypatch, left, alike, verdict):
    """Of 0.8 and 0.85 the first is likelier by 6 nats; the second effect's further parameter costs 2.6."""
    first, second = candidate("black_level", left=0.8), candidate("veiling_glare", left=left)
    second.evidence -= 2.7
    found = decided(monkeypatch, candidate(left=9.0), [first, second], None, alike=alike)
    assert found.verdict is verdict
    assert found.chosen.ids == first.ids
    if verdict is Verdict.AMBIGUOUS:
        assert found.ambiguous == (("black_level", "veiling_glare"),)


def test_what_is_to_be_told_apart_is_what_is_in_question(monkeypatch):
    fume, gamma, window = (candidate(name) for name in ("fume", "gamma", "dirty_window"))

    def pair(verdict, *ambiguous, alike=(), named=("fume",)):
        singles, chosen = (fume, gamma, window), SimpleNamespace(ids=named)
        return in_question(
            SimpleNamespace(verdict=verdict, singles=singles, ambiguous=ambiguous, alike=alike, chosen=chosen)
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
    held_back = candidate("dirty_window", left=1.2)
    held_back.is_held_back = True
    singles = [candidate("veiling_glare", left=1.22), held_back, candidate("fume", left=3.0)]
    baseline = candidate(left=4.0)
    decision = SimpleNamespace(singles=singles, confidence=[0.5, 0.4, 0.0])
    between = likelihood_nats(2.0) - baseline.evidence
    random = SimpleNamespace(
        evidence={"speckle": between}, confidence={"speckle": 1.0}, closed={"speckle": 0.3}
    )
    ranked = ranking(decision, baseline, random)
    assert [one.id for one in ranked] == ["veiling_glare", "dirty_window", "speckle", "fume"]
    assert ranked[1].is_held_back
