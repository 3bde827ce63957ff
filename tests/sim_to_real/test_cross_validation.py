"""Frames held back: every kind of condition on either side."""

from types import SimpleNamespace

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from sim_to_real.data.cross_validation import split_holdout

STRATA = ["dark", "laser", "arc", "both"]
KINDS = st.lists(st.sampled_from(STRATA), min_size=1, max_size=40)
SHORT, LONG = 0.0025, 0.005


def recording(kinds, exposures_s=None):
    frames = [
        SimpleNamespace(
            position=n, stratum=kind, condition=SimpleNamespace(exposure_s=exposure_s, arc_level=1.0)
        )
        for n, (kind, exposure_s) in enumerate(zip(kinds, exposures_s or [LONG] * len(kinds), strict=True))
    ]
    return SimpleNamespace(frames=frames, subset=lambda chosen: np.flatnonzero(chosen).tolist())


def wanted_of(kinds, share):
    """How many of each kind are to be held back: its share, or one of each where that is none of any."""
    shares = {kind: round(share * kinds.count(kind)) for kind in kinds}
    return shares if any(shares.values()) else dict.fromkeys(kinds, 1)


@given(KINDS, st.floats(0.05, 0.5))
@example(["dark", "laser", "arc", "both"] * 2, 0.25)
def test_every_kind_is_left_to_fit(kinds, share):
    held = split_holdout(recording(kinds), share)
    assert {kind for kind, is_held in zip(kinds, held, strict=True) if not is_held} == set(kinds)
    for kind, wanted in wanted_of(kinds, share).items():
        of_kind = np.array(kinds) == kind
        assert held[of_kind].sum() == min(of_kind.sum() - 1, wanted)


@given(
    st.lists(st.tuples(st.sampled_from(STRATA), st.sampled_from([SHORT, LONG])), min_size=1, max_size=40),
    st.floats(0.05, 0.5),
)
def test_every_condition_is_left_to_fit_and_as_many_are_held_as_that_allows(conditions, share):
    kinds, exposures_s = (list(values) for values in zip(*conditions, strict=True))
    held = split_holdout(recording(kinds, exposures_s), share)
    assert {item for item, is_held in zip(conditions, held, strict=True) if not is_held} == set(conditions)
    for kind, wanted in wanted_of(kinds, share).items():
        of_kind = np.array(kinds) == kind
        n_conditions = len({item for item in conditions if item[0] == kind})
        assert held[of_kind].sum() == min(of_kind.sum() - n_conditions, wanted)


def test_measured_exposures_that_scatter_are_one_condition():
    kinds = ["laser", "both"] * 12
    scatters = 1.0 + 1e-3 * np.random.default_rng(0).standard_normal(24)
    exposures_s = [(SHORT if n < 8 else LONG) * values for n, values in enumerate(scatters)]
    held = split_holdout(recording(kinds, exposures_s), 0.25)
    assert [int(held[kind::2].sum()) for kind in (0, 1)] == [3, 3]
    assert not held[:8].all()
    assert not held[8:].all()
