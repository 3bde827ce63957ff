"""Several effects: what explains a gap together, and whose share of it is whose."""

from types import SimpleNamespace

import pytest

from sim_to_real.search import stepwise as room
from sim_to_real.search.single_effects import Search
from tests.sim_to_real.verdicts import hypothesis


@pytest.mark.parametrize(
    ("foreseen", "fitted", "seen", "explain"),
    [
        (1.19, 1.1, 1.0, True),
        (1.35, 1.1, 1.0, False),
        (1.35, 0.95, 1.0, True),
        (1.6, 0.95, 1.0, False),
        # Bins are predicted by a coarse camera, pixels are not.
        (1.35, 1.1, 0.69, True),
        (1.6, 1.1, 0.69, False),
    ],
)
def test_several_that_leave_nothing_where_they_were_fitted_need_not_foresee_as_well(
    monkeypatch, foreseen, fitted, seen, explain
):
    pair = hypothesis("laser_power_drift", "defocus", mean_square=foreseen)
    pair.refit.mean_square = fitted
    joint = further(monkeypatch, hypothesis("laser_power_drift", mean_square=2.5), [pair], seen=seen)
    assert (joint and joint.ids) == (pair.ids if explain else None)


def further(monkeypatch, best, pairs, seen=1.0, by_look=()):
    """Look for further effects; pairs leave what is `seen` in pixels, and some are likely `by_look`."""
    monkeypatch.setattr(room, "score_catalogue", lambda *_: ["a score"])
    for name in ("fit_single_effects", "with_expensive"):
        monkeypatch.setattr(room, name, lambda *_: pairs)
    monkeypatch.setattr(room, "refit_from", lambda *_: None)
    monkeypatch.setattr(room, "cross_validated", lambda *_: hypothesis("defocus", mean_square=4.0))
    search = Search(SimpleNamespace(), (), lambda _: [seen], print)
    return room.stepwise(search, hypothesis(mean_square=9.0), best, by_look)


def test_two_effects_that_a_third_mimics_explain_what_is_not_explained_beside_it(monkeypatch):
    mimic, beside_it = (
        hypothesis("dirty_window", mean_square=4.0),
        hypothesis("dirty_window", "fume", mean_square=3.5),
    )
    pair = hypothesis("arc_deflection", "argon_line_leak", mean_square=0.8)
    assert further(monkeypatch, mimic, [beside_it]) is None
    assert further(monkeypatch, mimic, [beside_it], by_look=[pair]) is pair


@pytest.mark.parametrize(("alone", "named"), [(0.79, ("gamma",)), (0.81, ("gamma", "defocus"))])
def test_evidence_of_its_own_names_an_effect_of_a_small_share(monkeypatch, alone, named):
    """Both leave less than the floor: 0.72 after 0.79 are 9.3 nats, after 0.81 they are 11.8."""
    pair = hypothesis("gamma", "defocus", mean_square=0.72)
    mean_square = {("gamma",): alone, ("defocus",): 9.0, ("gamma", "defocus"): 0.72}
    monkeypatch.setattr(
        room,
        "refit_from",
        lambda _, __, effects: hypothesis(*effects, mean_square=mean_square[tuple(effects)]),
    )
    monkeypatch.setattr(room, "cross_validated", lambda _, values: values)
    result, share = room.with_shares(None, hypothesis(mean_square=9.0), pair)
    assert result.ids == tuple(share) == named


@pytest.mark.parametrize(
    ("baseline", "alone", "share"),
    [
        # Below the model's floor all that there is counts: of sqrt(0.3) either leaves sqrt(0.1).
        ((0.95, 0.65), (0.75, 0.75), (0.5, 0.5)),
        ((5.0, 0.9), (1.0, 5.0), (1.0, 0.0)),
        # Alone the second one would do harm, and is left neutral: beside the first it closes 0.5 of 2.
        ((5.0, 1.0), (1.25, 9.0), (0.875, 0.125)),
        # Nothing is closed at all.
        ((0.8, 0.8), (0.8, 0.8), (0.5, 0.5)),
    ],
)
def test_shares_below_the_floor_are_shares_still(monkeypatch, baseline, alone, share):
    pair = hypothesis("gamma", "fume", mean_square=baseline[1])
    mean_square = dict(zip(("gamma", "fume"), alone, strict=True))
    monkeypatch.setattr(room, "refit_from", lambda _, __, effects: effects)
    monkeypatch.setattr(
        room,
        "cross_validated",
        lambda _, effects: SimpleNamespace(cv_mean_square=mean_square[next(iter(effects))]),
    )
    result = room.shares(None, hypothesis(mean_square=baseline[0]), pair)
    assert tuple(result.values()) == pytest.approx(share)
