"""What a blind check is made of."""

from collections import Counter

import numpy as np
import pytest

from validation.blind_check.plan import DRY, N_WORLDS, plan
from validation.second_renderer.scenario import TIERS
from validation.second_renderer.world import FORMS
from validation.second_renderer.world_effect import CATALOGUE
from validation.second_renderer.world_stated import draw_stated


@pytest.fixture(scope="module")
def planned():
    return plan(3, 10, seed=4)


def test_every_effect_is_hidden_as_often(planned):
    of = {tier: [one for one in planned if one.tier == tier] for tier in TIERS}
    assert Counter(one.effects for one in of["A"]) == {(name,): 3 for name in FORMS}
    assert all(one.form is None for one in of["A"] + of["D"])
    assert Counter(name for one in of["D"] for name in one.effects) == dict.fromkeys(FORMS, 3)
    assert [one.effects for one in of["E"]] == 10 * [()]
    plain = Counter((one.effects[0], one.is_dry) for one in of["F"])
    assert plain == {(name, False): 3 for name in FORMS} | {(name, True): 3 for name in DRY}
    others = {name: [form for form in forms if form != CATALOGUE] for name, forms in FORMS.items()}
    for name, forms in others.items():
        drawn = Counter(one.form for one in of["C"] if one.effects == (name,))
        assert sum(drawn.values()) == (3 if forms else 0)
        assert set(drawn) <= set(forms)
        assert not drawn or max(drawn.values()) - min(drawn.values()) <= 1


@pytest.mark.slow
def test_numbers_tell_nothing_and_seeds_differ(planned):
    assert [one.number for one in planned] == list(range(1, len(planned) + 1))
    order = [list(FORMS).index(one.effects[0]) for one in planned if one.tier == "A"]
    assert abs(np.corrcoef(order, np.arange(len(order)))[0, 1]) < 0.3
    assert len({one.seed for one in planned}) == len(planned)
    assert planned == plan(3, 10, seed=4)
    assert not {one.seed for one in planned} & {one.seed for one in plan(3, 10, seed=5)}


def test_worlds_are_shared_and_show_what_they_hide(planned):
    worlds = Counter((one.world_seed, one.joint) for one in planned)
    assert len(worlds) == N_WORLDS
    assert len({joint for _, joint in worlds}) == 3
    assert max(worlds.values()) < 2 * min(worlds.values())
    bounced = [one for one in planned if "interreflection" in one.effects]
    assert bounced
    for one in bounced:
        stated, _ = draw_stated(np.random.default_rng([one.world_seed, 0]), one.joint)
        assert stated.material.name == "zn_coated"


def test_tiers_that_cannot_be():
    with pytest.raises(ValueError, match="tier 'G' is not known"):
        plan(1, 1, "AG")
    with pytest.raises(ValueError, match="name both"):
        plan(1, 1, "BE")
    assert {one.tier for one in plan(1, 1, "AB")} == {"A"}
    assert [one.tier for one in plan(1, 2, "E")] == ["E", "E"]


@pytest.mark.usefixtures("mitsuba")
def test_a_plan_can_be_drawn(planned):
    from validation.second_renderer.scenario import draw

    (one, *_) = [one for one in planned if "interreflection" in one.effects and one.joint == "v_groove"]
    scenario = draw(
        one.seed, one.tier, world_seed=one.world_seed, joint=one.joint, effects=one.effects, form=one.form
    )
    assert scenario.labels["effects"] == list(one.effects)
