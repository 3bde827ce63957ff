"""What becomes of a verdict when frames that nothing was fitted to have been looked at."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from noise_model.effects import REGISTRY
from sim_to_real.decision.decide import Decision
from sim_to_real.decision.holdout_checks import (
    checked_on_holdout,
    names_negligible,
    random_shares,
    required_probability,
    with_random_effects,
    with_withheld,
    without_negligible,
    without_unconfirmed,
)
from sim_to_real.diagnosis import Gap, Verdict
from sim_to_real.fit.trend import Driver, Trend
from sim_to_real.search.probe_points import effect_size
from tests.sim_to_real.verdicts import hypothesis


def neutral(name):
    """What a setup without effects states of one."""
    return REGISTRY[name].neutral


@dataclass
class Scattering:
    """The part of a `Scatter` that a verdict asks for."""

    closed: dict[str, float] = field(default_factory=dict)

    @property
    def effects(self):
        return {name: {} for name in self.closed}


def decision(verdict, *ids):
    return Decision(verdict, hypothesis(*ids), 1.0, (), np.empty(0), (), (), {}, ())


def gap(after, ci95, before=5.0, floor=0.2):
    return Gap(before, after, floor, (before - after) / (before - floor), ci95, (1.0, 1.0), (0.0, 0.0))


def test_an_effect_that_surely_closes_less_than_half_is_not_named():
    named, baseline = decision(Verdict.EFFECTS, "gamma"), hypothesis(mean_square=9.0)
    assert checked_on_holdout(named, baseline, gap(4.0, (0.1, 0.4))).verdict is Verdict.UNKNOWN
    assert checked_on_holdout(named, baseline, gap(0.5, (0.4, 0.95))).verdict is Verdict.EFFECTS
    # Of a small gap it may be chance.
    assert checked_on_holdout(named, baseline, gap(0.28, (0.2, 0.6), before=0.35)).verdict is Verdict.EFFECTS
    assert (
        checked_on_holdout(named, hypothesis(mean_square=0.9), gap(0.5, (0.1, 0.4), before=0.55)).verdict
        is Verdict.NO_GAP
    )


def test_a_gap_that_pixels_clearly_show_is_never_none():
    """Bins may not: light that bounces stays near the root."""
    nothing, baseline = decision(Verdict.NO_GAP), hypothesis(mean_square=1.1)
    # The floor is 0.2.
    assert checked_on_holdout(nothing, baseline, gap(0.59, (0.0, 0.0), before=0.59)).verdict is Verdict.NO_GAP
    assert (
        checked_on_holdout(nothing, baseline, gap(0.61, (0.0, 0.0), before=0.61)).verdict is Verdict.UNKNOWN
    )
    named = decision(Verdict.EFFECTS, "gamma")
    assert (
        checked_on_holdout(named, hypothesis(mean_square=0.9), gap(4.0, (0.1, 0.4))).verdict
        is Verdict.UNKNOWN
    )


def test_a_gap_below_the_floor_is_none_but_for_an_effect_that_is_no_trifle():
    baseline = hypothesis(mean_square=1.1)
    below, above, clear = (gap(0.05, (0.9, 1.0), before=before) for before in (0.19, 0.21, 0.41))
    unknown, noise = decision(Verdict.UNKNOWN, "roughness_change"), decision(Verdict.EFFECTS)
    for values in (unknown, noise):
        assert checked_on_holdout(values, baseline, below).verdict is Verdict.NO_GAP
        assert checked_on_holdout(values, baseline, above).verdict is values.verdict
    # The prior of ln c2 has a sigma of 0.7.
    for c2_ln, in_small in ((-0.06, True), (-0.08, False)):
        named = decision(Verdict.EFFECTS, "roughness_change")
        named.chosen.refit.effects["roughness_change"] = {"c2_ln": c2_ln}
        assert checked_on_holdout(named, baseline, below).verdict is Verdict.EFFECTS
        assert names_negligible(named, baseline, below, neutral) is in_small
        assert names_negligible(named, baseline, above, neutral) is in_small
        assert names_negligible(named, hypothesis(mean_square=0.9), clear, neutral) is in_small
        assert not names_negligible(named, baseline, clear, neutral)
        # From 1.2 to 1 it gains 100 ln 1.2 = 18 nats.
        assert not names_negligible(named, hypothesis(mean_square=1.2), above, neutral)
        assert names_negligible(named, hypothesis(mean_square=1.2), below, neutral) is in_small


def test_beside_a_trifle_what_scatters_is_named():
    trifle, noise = decision(Verdict.EFFECTS, "roughness_change"), Scattering({"read_noise": 0.9})
    assert without_negligible(trifle, hypothesis(mean_square=1.1), Scattering()).verdict is Verdict.NO_GAP
    result = without_negligible(trifle, hypothesis(mean_square=1.1), noise)
    assert (result.verdict, result.chosen.ids) == (Verdict.EFFECTS, ())


def test_what_scatters_must_close_half_of_a_gap_as_well():
    noise = decision(Verdict.EFFECTS)
    assert (
        checked_on_holdout(noise, hypothesis(mean_square=9.0), gap(3.5, (0.2, 0.4))).verdict
        is Verdict.UNKNOWN
    )
    assert (
        checked_on_holdout(noise, hypothesis(mean_square=9.0), gap(2.0, (0.4, 0.7))).verdict
        is Verdict.EFFECTS
    )


def test_the_shape_of_an_effect_says_nothing_of_its_size():
    marks = {"anisotropy": 0.05, "marks_deg": 60.0}
    assert effect_size({"rolling_marks": marks}, neutral) == pytest.approx(0.1)
    assert effect_size({"rolling_marks": marks, "arc_length": {"height_mm": -0.3}}, neutral) == pytest.approx(
        0.3
    )


@pytest.mark.parametrize(
    ("ids", "least"),
    [
        # The floor is 0.2, sqrt(2) of it 0.283; the gap before 5.
        (("vignetting",), math.hypot(0.283, 0.5)),
        (("arc_radius",), math.hypot(0.283, 0.25)),
        (("fume",), math.hypot(0.283, 2.5)),
        (("fume", "gamma"), math.hypot(0.283, 0.25)),
    ],
)
def test_what_is_named_must_leave_no_more_than_model_and_form_may_be_off(ids, least):
    """An arc of another size leaves 8 % of what another metal makes: of a radius that is too much."""
    named, baseline = decision(Verdict.EFFECTS, *ids), hypothesis(mean_square=9.0)
    assert checked_on_holdout(named, baseline, gap(1.01 * least, (0.8, 0.9))).verdict is Verdict.UNKNOWN
    assert checked_on_holdout(named, baseline, gap(0.99 * least, (0.8, 0.9))).verdict is Verdict.EFFECTS


def test_pixels_held_out_need_not_be_as_sure_of_what_many_bins_say():
    named, baseline = decision(Verdict.EFFECTS, "defocus"), hypothesis(mean_square=1.0)
    # From 1.2 to 1 it gains 100 ln 1.2 = 18 nats.
    assert required_probability(named, baseline) > 0.95
    assert required_probability(named, hypothesis(mean_square=1.2)) == 0.5


@pytest.mark.parametrize(("mean_square", "verdict"), [(1.2, Verdict.NO_GAP), (9.0, Verdict.UNKNOWN)])
def test_what_does_not_hold_up_leaves_what_the_baseline_says(mean_square, verdict):
    result = without_unconfirmed(
        decision(Verdict.EFFECTS, "gamma"), hypothesis(mean_square=mean_square), Scattering()
    )
    assert result.verdict is verdict
    assert result.chosen.ids == ()


def test_what_scatters_is_named_where_it_is_most_of_the_gap():
    loud, faint = Scattering({"read_noise": 0.9}), Scattering({"read_noise": 0.1})
    assert random_shares(loud)["read_noise"] == pytest.approx(0.99)
    baseline = hypothesis()
    assert with_random_effects(decision(Verdict.UNKNOWN, "fume"), baseline, loud).verdict is Verdict.EFFECTS
    assert with_random_effects(decision(Verdict.UNKNOWN, "fume"), baseline, faint).verdict is Verdict.UNKNOWN
    assert with_random_effects(decision(Verdict.NO_GAP), baseline, faint).verdict is Verdict.EFFECTS
    assert with_random_effects(decision(Verdict.NO_GAP), baseline, Scattering()).verdict is Verdict.NO_GAP


def test_what_scatters_and_is_withheld_is_unknown():
    noise, named = Scattering({"read_noise": 0.9}), decision(Verdict.EFFECTS, "gamma")
    assert with_withheld(decision(Verdict.NO_GAP), noise, ("read_noise",)).verdict is Verdict.UNKNOWN
    assert with_withheld(decision(Verdict.NO_GAP), noise, ("gamma",)).verdict is Verdict.NO_GAP
    assert with_withheld(named, noise, ("read_noise",)).verdict is Verdict.EFFECTS


def test_an_effect_that_changes_from_one_side_to_the_other_is_no_trifle():
    """Half-way along the weld arc blow from -1 to 1 mm is nothing."""
    blow = decision(Verdict.EFFECTS, "arc_deflection")
    fitted = blow.chosen.refit
    fitted.effects["arc_deflection"] = {"x_mm": 0.0, "y_mm": 0.01}
    small = replace(gap(0.1, (0.8, 0.9)), before=0.1)
    assert names_negligible(blow, hypothesis(mean_square=1.1), small, neutral)
    fitted.trend = Trend("arc_deflection", Driver.TIME, 1.0, 1.0, (0.0, 1.0))
    assert not names_negligible(blow, hypothesis(mean_square=1.1), small, neutral)
