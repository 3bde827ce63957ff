"""What becomes of a verdict when frames that nothing was fitted to have been looked at."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from noise_model.effects import REGISTRY
from sim_to_real import verdict as room
from sim_to_real.diagnosis import Gap, Verdict
from sim_to_real.quadratic import N_EFFECTIVE
from sim_to_real.screen import size
from sim_to_real.select import likelihood_nats
from sim_to_real.verdict import (
    Decision,
    closing,
    decide,
    must_help,
    not_held_up,
    random_shares,
    with_random,
    with_withheld,
)


@dataclass
class Scattering:
    """The part of a `Scatter` that a verdict asks for."""

    closed: dict[str, float] = field(default_factory=dict)

    @property
    def effects(self):
        return {name: {} for name in self.closed}


@dataclass
class Fitted:
    """The part of a `Candidate` that a verdict asks for."""

    ids: tuple[str, ...]
    left: float
    refit: SimpleNamespace
    evidence: float
    left_in_pixels: float = np.nan
    is_held_back: bool = False


def candidate(*ids, left=1.0):
    effects = {name: REGISTRY[name].complete(REGISTRY[name].typical) for name in ids}
    fit = SimpleNamespace(ids=ids, residuals=np.full(4, np.sqrt(left)), nuisance=None, effects=effects)
    return Fitted(ids, left, fit, likelihood_nats(left))


def decision(verdict, *ids):
    return Decision(verdict, candidate(*ids), 1.0, (), np.empty(0), (), (), None)


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
):
    """Decide between fits that are handed in; `seen` is what all leave in pixels, or each by its effects.

    `again` is the likeliest one after it has settled, `dear` are the fits with those that take long,
    `changes` those whose size may change from frame to frame.
    """
    left = seen if isinstance(seen, dict) else {}
    answers = {"looked": looks, "candidates": singles, "_several": several}
    answers |= {"with_dear": dear or singles, "with_changes": changes or singles}
    for name, answer in answers.items():
        monkeypatch.setattr(room, name, lambda *_, answer=answer: answer)
    monkeypatch.setattr(room, "refit", lambda *_, **__: None)
    monkeypatch.setattr(room, "told_apart", lambda found, baseline, _: (found, baseline))
    monkeypatch.setattr(room, "_again", lambda _, of: again or of)
    expected = SimpleNamespace(
        take_tangents=lambda *_: None,
        neutral=None,
        passed=lambda *_: [],
        residuals=lambda _: baseline.refit.residuals,
    )
    return decide(expected, baseline, (), lambda fits: [left.get(fit.ids, seen) for fit in fits], print)


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
    """Of 9 - 1 the pair may leave 4."""
    seen = {("gamma",): 9.0, ("gamma", "fume"): left}
    pair = candidate("gamma", "fume", left=0.7)
    found = decided(monkeypatch, candidate(left=9.0), [candidate("gamma", left=1.0)], pair, seen)
    assert (found.verdict, found.chosen.ids) == (Verdict.EFFECTS, named)
    seen[("gamma",)] = 1.4
    found = decided(monkeypatch, candidate(left=9.0), [candidate("gamma", left=1.0)], pair, seen)
    assert found.chosen.ids == ("gamma",)


def test_what_pixels_show_of_a_fit_that_had_not_settled_is_no_other_effect(monkeypatch):
    """The first fit leaves 9 in pixels, which a second effect would explain; settled it leaves 1."""
    settled = candidate("gamma", left=0.9)
    settled.left_in_pixels = 1.0
    pair = candidate("gamma", "fume", left=0.7)
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


@pytest.mark.parametrize(
    ("foreseen", "fitted", "explain"),
    [(1.19, 1.1, True), (1.35, 1.1, False), (1.35, 0.95, True), (1.6, 0.95, False)],
)
def test_several_that_leave_nothing_where_they_were_fitted_need_not_foresee_as_well(
    monkeypatch, foreseen, fitted, explain
):
    best, pair = (
        candidate("laser_power_drift", left=2.5),
        candidate("laser_power_drift", "defocus", left=foreseen),
    )
    pair.refit.mean_square = fitted
    monkeypatch.setattr(room, "looked", lambda *_: ["a look"])
    for name in ("candidates", "with_dear"):
        monkeypatch.setattr(room, name, lambda *_: [pair])
    monkeypatch.setattr(room, "refit", lambda *_: None)
    monkeypatch.setattr(room, "judged", lambda *_: candidate("defocus", left=4.0))
    found = room._several(None, candidate(left=9.0), best, (), print)
    assert found is (pair if explain else None)


def gap(after, ci95, before=5.0, floor=0.2):
    return Gap(before, after, floor, (before - after) / (before - floor), ci95, (1.0, 1.0), (0.0, 0.0))


def test_an_effect_that_surely_closes_less_than_half_is_not_named():
    named, baseline = decision(Verdict.EFFECTS, "gamma"), candidate(left=9.0)
    assert closing(named, baseline, gap(4.0, (0.1, 0.4))).verdict is Verdict.UNKNOWN
    assert closing(named, baseline, gap(0.5, (0.4, 0.95))).verdict is Verdict.EFFECTS
    # Of a small gap it may be chance.
    assert closing(named, baseline, gap(0.28, (0.2, 0.6), before=0.35)).verdict is Verdict.EFFECTS
    assert closing(decision(Verdict.NO_GAP), baseline, gap(5.0, (0.0, 0.0))).verdict is Verdict.NO_GAP
    assert closing(named, candidate(left=0.9), gap(4.0, (0.1, 0.4))).verdict is Verdict.NO_GAP


def test_a_gap_below_the_floor_is_none_but_for_an_effect_that_is_no_trifle():
    baseline = candidate(left=1.1)
    below, above, clear = (gap(0.05, (0.9, 1.0), before=before) for before in (0.19, 0.21, 0.41))
    unknown, noise = decision(Verdict.UNKNOWN, "roughness_change"), decision(Verdict.EFFECTS)
    for of in (unknown, noise):
        assert closing(of, baseline, below).verdict is Verdict.NO_GAP
        assert closing(of, baseline, above).verdict is of.verdict
    # The prior of ln c2 has a sigma of 0.7.
    for c2_ln, in_small in ((-0.06, Verdict.NO_GAP), (-0.08, Verdict.EFFECTS)):
        named = decision(Verdict.EFFECTS, "roughness_change")
        named.chosen.refit.effects["roughness_change"] = {"c2_ln": c2_ln}
        assert closing(named, baseline, below).verdict is in_small
        assert closing(named, baseline, above).verdict is in_small
        assert closing(named, candidate(left=0.9), clear).verdict is in_small
        assert closing(named, baseline, clear).verdict is Verdict.EFFECTS
        # From 1.2 to 1 it gains 100 ln 1.2 = 18 nats.
        assert closing(named, candidate(left=1.2), above).verdict is Verdict.EFFECTS


def test_the_shape_of_an_effect_says_nothing_of_its_size():
    marks = {"anisotropy": 0.05, "marks_deg": 60.0}
    assert size({"rolling_marks": marks}) == pytest.approx(0.1)
    assert size({"rolling_marks": marks, "arc_length": {"height_mm": -0.3}}) == pytest.approx(0.3)


def test_what_its_bounds_hold_back_explains_nothing(monkeypatch):
    held_back = candidate("dirty_window", left=0.9)
    assert decided(monkeypatch, candidate(left=9.0), [held_back], None).verdict is Verdict.EFFECTS
    held_back.is_held_back = True
    assert decided(monkeypatch, candidate(left=9.0), [held_back], None).verdict is Verdict.UNKNOWN


@pytest.mark.parametrize(
    ("ids", "least"),
    [
        # The floor is 0.2, sqrt(2) of it 0.283; the gap before 5.
        (("gamma",), math.hypot(0.283, 0.5)),
        (("arc_radius",), math.hypot(0.283, 0.25)),
        (("fume",), math.hypot(0.283, 2.5)),
        (("fume", "gamma"), math.hypot(0.283, 0.25)),
    ],
)
def test_what_is_named_must_leave_no_more_than_model_and_form_may_be_off(ids, least):
    """An arc of another size leaves 8 % of what another metal makes: of a radius that is too much."""
    named, baseline = decision(Verdict.EFFECTS, *ids), candidate(left=9.0)
    assert closing(named, baseline, gap(1.01 * least, (0.8, 0.9))).verdict is Verdict.UNKNOWN
    assert closing(named, baseline, gap(0.99 * least, (0.8, 0.9))).verdict is Verdict.EFFECTS


def test_pixels_held_out_need_not_be_as_sure_of_what_many_bins_say():
    named, baseline = decision(Verdict.EFFECTS, "defocus"), candidate(left=1.0)
    # From 1.2 to 1 it gains 100 ln 1.2 = 18 nats.
    assert must_help(named, baseline) > 0.95
    assert must_help(named, candidate(left=1.2)) == 0.5


@pytest.mark.parametrize(("left", "verdict"), [(1.2, Verdict.NO_GAP), (9.0, Verdict.UNKNOWN)])
def test_what_does_not_hold_up_leaves_what_the_baseline_says(left, verdict):
    found = not_held_up(decision(Verdict.EFFECTS, "gamma"), candidate(left=left), Scattering())
    assert found.verdict is verdict
    assert found.chosen.ids == ()


def test_what_scatters_is_named_where_it_is_most_of_the_gap():
    loud, faint = Scattering({"read_noise": 0.9}), Scattering({"read_noise": 0.1})
    assert random_shares(loud)["read_noise"] == pytest.approx(0.99)
    baseline = candidate()
    assert with_random(decision(Verdict.UNKNOWN, "fume"), baseline, loud).verdict is Verdict.EFFECTS
    assert with_random(decision(Verdict.UNKNOWN, "fume"), baseline, faint).verdict is Verdict.UNKNOWN
    assert with_random(decision(Verdict.NO_GAP), baseline, faint).verdict is Verdict.EFFECTS
    assert with_random(decision(Verdict.NO_GAP), baseline, Scattering()).verdict is Verdict.NO_GAP


def test_what_scatters_and_is_withheld_is_unknown():
    noise, named = Scattering({"read_noise": 0.9}), decision(Verdict.EFFECTS, "gamma")
    assert with_withheld(decision(Verdict.NO_GAP), noise, ("read_noise",)).verdict is Verdict.UNKNOWN
    assert with_withheld(decision(Verdict.NO_GAP), noise, ("gamma",)).verdict is Verdict.NO_GAP
    assert with_withheld(named, noise, ("read_noise",)).verdict is Verdict.EFFECTS
