"""What a blind check is made of."""

import hashlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from validation.blind_check.plan import DRY, N_WIDE_WORLDS, N_WORLDS, plan
from validation.second_renderer.scenario import TIERS, WIDE_STREAM, WIDE_TIERS
from validation.second_renderer.world import FORMS
from validation.second_renderer.world_effect import CATALOGUE
from validation.second_renderer.world_stated import WIDE_JOINTS, draw_stated, draw_wide


@pytest.fixture(scope="module")
def planned():
    return plan(3, 10, seed=4)


def test_every_effect_is_hidden_as_often(planned):
    of = {tier: [one for one in planned if one.tier == tier] for tier in TIERS}
    assert Counter(one.effects for one in of["A"]) == {(name,): 3 for name in FORMS}
    assert all(one.form is None for one in of["A"] + of["D"] + of["G"] + of["H"])
    assert Counter(one.effects for one in of["G"]) == {(name,): 3 for name in FORMS}
    assert {len(set(one.effects)) for one in of["H"]} == {3}
    assert Counter(name for one in of["H"] for name in one.effects) == dict.fromkeys(FORMS, 3)
    assert [one.effects for one in of["I"]] == 10 * [()]
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
    worlds = Counter((one.world_seed, one.joint) for one in planned if one.tier not in WIDE_TIERS)
    assert len(worlds) == N_WORLDS
    assert len({joint for _, joint in worlds}) == 3
    assert max(worlds.values()) < 2 * min(worlds.values())
    wide = Counter((one.world_seed, one.joint) for one in planned if one.tier in WIDE_TIERS)
    assert len(wide) == N_WIDE_WORLDS
    assert {joint for _, joint in wide} == set(WIDE_JOINTS)
    assert max(wide.values()) < 3 * min(wide.values())
    for is_wide, drawn in ((False, draw_stated), (True, draw_wide)):
        bounced = [
            one for one in planned if "interreflection" in one.effects and (one.tier in WIDE_TIERS) == is_wide
        ]
        assert bounced
        for one in bounced:
            draw = np.random.default_rng([one.world_seed, WIDE_STREAM if is_wide else 0])
            stated, _ = drawn(draw, one.joint)
            assert stated.material.name == "zn_coated"
            assert stated.joint.type not in ("butt", "outside_corner")


def test_the_plans_of_older_checks_are_unchanged():
    """Equal options make equal recordings: the archives' labels can be rendered again."""
    for arguments, digest in (
        ((2, 4, "ABCDEF", 5, 160), "ab2f6fec69f2b78b"),
        ((1, 0, "AB", 9), "11ab5997e243e796"),
    ):
        planned = plan(*arguments)
        assert hashlib.sha256(repr(planned).encode()).hexdigest()[:16] == digest
    older, newer = (plan(1, 3, tiers, 7) for tiers in ("ABCDEF", "ABCDEFGHI"))

    def kept(planned):
        return {one.seed: replace(one, number=0) for one in planned if one.tier not in WIDE_TIERS}

    assert kept(older) == kept(newer)


def test_tiers_that_cannot_be():
    with pytest.raises(ValueError, match="tier 'Z' is not known"):
        plan(1, 1, "AZ")
    with pytest.raises(ValueError, match="name one of them too"):
        plan(1, 1, "BE")
    assert {one.tier for one in plan(1, 1, "AB")} == {"A"}
    assert {one.tier for one in plan(1, 1, "BG")} == {"G"}
    assert [one.tier for one in plan(1, 2, "E")] == ["E", "E"]


@pytest.mark.usefixtures("mitsuba")
def test_a_plan_can_be_drawn(planned):
    from validation.second_renderer.scenario import draw

    (one, *_) = [one for one in planned if "interreflection" in one.effects and one.joint == "v_groove"]
    scenario = draw(
        one.seed, one.tier, world_seed=one.world_seed, joint=one.joint, effects=one.effects, form=one.form
    )
    assert scenario.labels["effects"] == list(one.effects)
