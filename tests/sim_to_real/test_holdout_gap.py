"""The gap in frames that were held back, and how sure its size is."""

from dataclasses import replace

import numpy as np
import pytest

from sim_to_real.decision.holdout_gap import measure_gap
from sim_to_real.decision.seam_error import UNKNOWN_ERRORS
from sim_to_real.diagnosis import HeldOutPrediction
from tests.sim_to_real.small import example_setup

SHAPE = 160, 200


def held(n_frames, off_dn, closed, seed=3):
    """Frames of which all are off alike where they are, by about `off_dn`, and after a share of it less."""
    rng = np.random.default_rng(seed)
    light = np.full(SHAPE, 60.0)
    noise = rng.standard_normal(SHAPE)
    off = off_dn * np.repeat(np.repeat(rng.standard_normal((4, 5)), 40, axis=0), 40, axis=1)

    def frames(image):
        return np.stack([image] * n_frames).astype(np.float32)

    return HeldOutPrediction(
        np.arange(n_frames),
        frames(light + noise + off),
        frames(light),
        frames(light + closed * off),
        frames(np.ones(SHAPE)),
        frames(np.ones(SHAPE)),
    )


def test_more_frames_that_are_off_alike_say_nothing_more():
    """A gap's interval is of the places that were seen: the model is off there in each frame."""
    setup = example_setup()
    once, often = (measure_gap(held(n, 3.0, 0.7), setup, UNKNOWN_ERRORS) for n in (1, 9))
    assert often.ci95 == pytest.approx(once.ci95)
    assert once.ci95[0] < once.closed < once.ci95[1]
    assert once.ci95[1] - once.ci95[0] > 0.02


def test_where_there_may_be_no_gap_the_share_closed_has_no_bounds():
    setup = example_setup()
    assert np.isnan(measure_gap(held(4, 0.3, 0.7), setup, UNKNOWN_ERRORS).ci95).all()


def test_a_gap_that_ends_below_the_floor_is_closed():
    """All of it and no more, though the noise leaves nothing of what the floor allows."""
    gap = measure_gap(held(4, 3.0, 1.0), example_setup(), UNKNOWN_ERRORS)
    assert gap.after < gap.floor
    assert gap.closed == 1.0
    assert gap.ci95[1] == 1.0


def test_what_explains_nothing_is_told_from_what_explains_little():
    """Both change the light by as much, below the model's floor: one as the frames do, one at random."""
    setup, off = example_setup(), held(4, 0.3, 0.2)
    unlike = np.random.default_rng(5).permutation((off.after - off.before)[0].ravel()).reshape(SHAPE)
    unlike = replace(off, after=off.before + unlike)
    some, nothing = (measure_gap(predicted, setup, UNKNOWN_ERRORS) for predicted in (off, unlike))
    assert not some.explains_nothing
    assert nothing.explains_nothing
