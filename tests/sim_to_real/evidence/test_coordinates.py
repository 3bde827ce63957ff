"""The coordinates of the stages, and what an unknown cause at one of them explains."""

from dataclasses import replace

import numpy as np
import pytest

from noise_model.effects.effect import Stage
from sim_to_real.evidence.coordinates import TOGETHER, even_hats, form_functions, free_terms, hats, hats_2d
from sim_to_real.evidence.metric import Metric
from tests.sim_to_real.planted import planted


@pytest.fixture(scope="module")
def covariates():
    return planted(n_frames=12, shape=(12, 16))


def test_hats_are_a_partition_of_one():
    values = np.random.default_rng(0).uniform(3.0, 9.0, 200).astype(np.float32)
    values[:5] = np.nan
    functions = hats(values, 6)
    assert functions.shape == (200, 6)
    np.testing.assert_allclose(functions[5:].sum(axis=1), 1.0, rtol=1e-6)
    assert not functions[:5].any()
    # A straight line lies within their span.
    line = np.linalg.lstsq(functions[5:], values[5:], rcond=None)[0]
    np.testing.assert_allclose(functions[5:] @ line, values[5:], atol=1e-4)


def test_few_values_have_a_hat_each():
    functions = hats(np.array([1.0, 4.0, 1.0, 4.0], dtype=np.float32), 5)
    np.testing.assert_array_equal(functions, [[1, 0], [0, 1], [1, 0], [0, 1]])
    assert hats(np.full(3, 2.0, dtype=np.float32), 5).tolist() == [[1.0], [1.0], [1.0]]


def test_even_hats_stand_as_far_apart_from_each_other():
    values = np.array([0.0, 1.0, 1.5, 40.0, np.nan], dtype=np.float32)
    expected = np.zeros((5, 41))
    expected[0, 0] = expected[1, 1] = expected[3, 40] = 1.0
    expected[2, 1:3] = 0.5
    np.testing.assert_allclose(even_hats(values, 41), expected, atol=1e-6)
    assert not even_hats(np.full(3, np.nan, dtype=np.float32), 4).any()


def test_over_the_image_they_are_products():
    rows, columns = (part.ravel().astype(np.float32) for part in np.indices((7, 9)))
    functions = hats_2d(rows, columns, 3, 4)
    assert functions.shape == (63, 12)
    np.testing.assert_allclose(functions.sum(axis=1), 1.0, rtol=1e-6)


def test_every_stage_has_functions_for_forms_and_terms_for_the_unknown(covariates):
    forms, free = form_functions(covariates), free_terms(covariates)
    assert set(forms) == set(Stage)
    # Planted frames change with nothing: neither a pose nor a clock changes them.
    assert {term.stage for term in free.terms} == {*Stage, None} - {Stage.GEOMETRY, Stage.TIMING}
    # Two hats beside each other share a bin, powers of the field angle add up; a profile ends.
    for functions in (of_coordinate for of_stage in forms.values() for of_coordinate in of_stage):
        variance = np.sum(functions**2, axis=1)
        assert 0.2 < variance.min() <= variance.max() < 2.0
    assert len({(term.stage, term.name) for term in free.terms}) == len(free.terms)


def test_the_terms_of_a_stage_together_have_all_its_blocks(covariates):
    terms = free_terms(covariates).terms
    together = {term.stage: set(term.blocks) for term in terms if term.name == TOGETHER}
    assert len(together) > 3
    for stage, blocks in together.items():
        alone = [term.blocks for term in terms if term.stage is stage and term.name != TOGETHER]
        assert blocks == {number for (number,) in alone}


def test_forms_of_a_stage_are_those_of_each_coordinate_and_of_all(covariates):
    *each, every = form_functions(covariates)[Stage.SENSOR]
    counts = [functions.shape[1] for functions in each]
    # A constant is among the functions of each: grey levels, frames, rows.
    assert counts[1:] == [1 + 12, 1 + 5]
    assert every.shape[1] == 1 + sum(count - 1 for count in counts)


def test_without_an_arc_nothing_of_it_is_a_cause(covariates):
    plain = replace(covariates, arc_dn=np.zeros_like(covariates.arc_dn))
    plain = replace(plain, values={**plain.values, "current": np.zeros_like(plain.arc_dn)})
    free = free_terms(plain)
    assert Stage.SOURCE not in {term.stage for term in free.terms}
    assert all(columns.any() for columns in free.columns)


def lasers(covariates):
    """The bins (n,) of frames with the laser on."""
    return np.isin(covariates.frame, np.unique(covariates.frame[covariates.in_stripe]))


@pytest.mark.parametrize(
    ("stage", "gap"),
    [
        (Stage.SURFACE, lambda c: c.arc_dn * 0.004 * (c.values["half_angle"] - 40.0)),
        (Stage.SENSOR, lambda c: 3.0 * np.sin(c.values["gray_level"] / 25.0)),
        (Stage.ILLUMINATION, lambda c: c.laser_dn * 0.1 * np.sin(c.values["column"] / 5.0)),
        (Stage.SOURCE, lambda c: c.arc_dn * 0.1 * np.cos(3.1 * c.frame)),
        (Stage.SENSOR, lambda c: 2.0 * np.cos(3.1 * c.frame)),
        # The stripe is wider; a second stripe stands beside it; the metal is dull in places.
        (Stage.ILLUMINATION, lambda c: c.laser_dn * 0.1 * (c.values["beside_sheet"] ** 2 - 2.0)),
        (Stage.OPTICS, lambda c: 4.0 * (lasers(c) & (np.abs(c.values["beside_sheet"] + 6.0) < 1.0))),
        (Stage.SURFACE, lambda c: c.light_dn * 0.1 * np.sin(c.part_mm[:, 0] / 3.0)),
        # Half of the part is brighter, and travels through the image.
        (Stage.ILLUMINATION, lambda c: 4.0 * (c.part_mm[:, 0] > 9.0)),
    ],
)
def test_a_gap_is_likeliest_at_the_stage_where_it_arises(covariates, stage, gap):
    rng = np.random.default_rng(2)
    residuals = np.nan_to_num(gap(covariates)) + rng.standard_normal(len(covariates.frame))
    n = len(residuals)
    metric, free = Metric(np.ones(n, dtype=np.float32), np.zeros((1, n))), free_terms(covariates)
    evidence = {
        (term.stage, term.name): metric.log_evidence(
            residuals, np.float32(0.1) * np.hstack([free.columns[n] for n in term.blocks])
        )
        for term in free.terms
    }
    nothing = metric.log_evidence(residuals, np.zeros((n, 1)))
    best = max(evidence, key=evidence.get)
    assert best[0] is stage
    assert evidence[best] > nothing + 20.0
