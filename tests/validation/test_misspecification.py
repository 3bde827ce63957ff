"""The benchmark that holds sbi's misspecification tests beside the diagnosis."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from tests.sim_to_real.planted import planted
from tests.sim_to_real.small import recorded
from validation.blind_check.case import FAILED, Answer, Case

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from misspecification import (
    Judged,
    Nominal,
    distortions_say,
    nominal_of,
    of_cells,
    of_spans,
    sampled,
    sbi_says,
    table,
    whitened,
)

N = 400


def nominal(columns, read_noise_rel=0.0):
    """Bins with noise of 0.7 of their variance, read noise of 0.2, and a floor of 0.3."""
    shares = (np.full(N, share, dtype=np.float32) for share in (0.7, 0.2, 0.3))
    return Nominal(np.zeros(N, dtype=np.float32), columns.astype(np.float32), *shares, read_noise_rel)


def test_draws_scatter_by_noise_floor_and_columns():
    columns = np.zeros((N, 1))
    columns[: N // 2] = 3.0
    drawn = nominal(columns).draw(4000, np.random.default_rng(0))
    # The floor's share is drawn evenly: half of it on average.
    assert np.var(drawn[:, N // 2 :]) == pytest.approx(0.85, rel=0.01)
    assert np.var(drawn[:, : N // 2]) == pytest.approx(9.85, rel=0.05)


def test_read_noise_within_its_tolerance_makes_recordings_scatter_differently():
    rng = np.random.default_rng(1)
    still, varied = (nominal(np.zeros((N, 1)), rel).draw(2000, rng).var(axis=1) for rel in (0.0, 0.5))
    # E((1 + 0.5 x)^2) - 1 is 0.25, of read noise of 0.2.
    assert varied.mean() - still.mean() == pytest.approx(0.05, abs=0.01)
    assert varied.std() > 1.5 * still.std()


def test_what_nuisances_can_do_is_subtracted_but_for_their_priors():
    rng = np.random.default_rng(2)
    columns = rng.normal(size=(N, 2))
    own = rng.normal(size=N)
    own -= columns @ np.linalg.lstsq(columns, own, rcond=None)[0]
    residuals = (columns @ [2.0, -1.0] + own)[np.newaxis].astype(np.float32)
    np.testing.assert_allclose(nominal(columns).remainder(residuals)[0], own, atol=0.05)


def test_a_free_term_holds_what_lies_in_its_span_and_counts_no_function_twice():
    rng = np.random.default_rng(3)
    first, second = (np.linalg.qr(rng.normal(size=(N, 3)))[0].astype(np.float32) for _ in range(2))
    twice = np.hstack([first, first[:, :1]])
    e = (6.0 * first[:, 0])[np.newaxis].astype(np.float32)
    summary = of_spans([twice, second, np.zeros((N, 2), dtype=np.float32)])(e)
    assert summary[0, 0] == pytest.approx(np.cbrt(36.0 / 3.0), abs=1e-4)
    projected = second.T @ e[0]
    assert summary[0, 1:] == pytest.approx([np.cbrt(projected @ projected / 3.0)], abs=1e-4)


def test_cells_hold_the_mean_square_of_each_stratum_in_each_part_of_the_image():
    of_bins = planted()
    e = np.where(of_bins.stratum == 3, 4.0, 2.0).astype(np.float32)[np.newaxis]
    e[0, (of_bins.values["row"] < 8.0) & (of_bins.values["column"] < 8.0)] *= 2.0
    summary = of_cells(of_bins)(e)[0].reshape(4, 3, 4)
    assert summary[0, 1, 1] == pytest.approx(np.cbrt(4.0), abs=1e-5)
    assert summary[3, 2, 3] == pytest.approx(np.cbrt(16.0), abs=1e-5)
    assert summary[3, 0, 0] == pytest.approx(np.cbrt(64.0), abs=1e-5)


def test_whitened_draws_have_unit_covariance_and_directions_without_variance_are_dropped():
    rng = np.random.default_rng(4)
    drawn = rng.normal(size=(3000, 2)) @ np.array([[2.0, 1.0, 3.0], [0.0, 0.5, 0.5]]) + 7.0
    observed, white = whitened(drawn[:1], drawn)
    np.testing.assert_allclose(np.cov(white, rowvar=False), np.eye(2), atol=1e-9)
    np.testing.assert_allclose(observed, white[:1])


@pytest.mark.slow
def test_a_recording_as_stated_is_one_of_those_drawn_and_one_with_another_response_is_not(tmp_path):
    excess = {}
    for name, effects in (("as stated", {}), ("gamma", {"gamma": {"gamma": 1.3}})):
        recorded(tmp_path / name, effects, coarser=4)
        model, summaries, _ = nominal_of(tmp_path / name)
        drawn = model.remainder(model.draw(300, np.random.default_rng(5)))
        of_recorded = model.remainder(model.recorded[np.newaxis])
        for summary, of in summaries.items():
            observed, _ = whitened(of(of_recorded), of(drawn))
            excess[name, summary] = np.mean(observed**2)
    assert excess["gamma", "free terms"] > 3.0 * excess["as stated", "free terms"]
    assert excess["as stated", "free terms"] < 3.0


def test_distortions_have_uniform_p_values_and_find_what_is_planted():
    """A distortion that nuisances take on, and that one column states twice, tells nothing."""
    rng = np.random.default_rng(8)
    distortions = np.hstack([rng.normal(size=(N, 20)), np.zeros((N, 1))]).astype(np.float32)
    drawn = rng.normal(size=(2000, N)).astype(np.float32)
    p = [distortions_say(e[np.newaxis], drawn[200:], distortions) for e in drawn[:200]]
    for name in ("largest", "sum"):
        assert kstest([said[name]["p"] for said in p], "uniform").pvalue > 0.05
    planted = drawn[:1] + 6.0 * distortions[:, 3] / np.linalg.norm(distortions[:, 3])
    found = distortions_say(planted.astype(np.float32), drawn[200:], distortions)
    assert found["largest"]["p"] < 0.01
    assert found["largest"]["excess"] > 3.0


def judged(tier, effects, p, excess, verdict="effects", named=()):
    said = {"p": p, "excess": excess}
    both = {test: said for test in ("log-prob", "MMD")}
    case = Case("0001", tier, effects, Answer(verdict, named), (("gamma", 0.9), ("fume", 0.1)))
    by_distortions = {"largest": said, "sum": said}
    content = {"free terms": both, "cells": both, "distortions": by_distortions}
    return Judged(case, {"said": content}, is_diagnosed=True)


def rows_of(text):
    """The cells of a table's rows by the first."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    return {row[0]: row[1:] for row in rows}


def test_the_table_counts_gaps_by_p_and_beyond_every_quiet_recording():
    rows = rows_of(
        table(
            [
                judged("E", (), 0.002, 5.0, "no_gap"),
                judged("E", (), 0.5, 1.0, "unknown"),
                judged("A", ("gamma",), 0.0, 4.0, named=("gamma",)),
                judged("A", ("fume",), 0.0, 6.0, named=("gamma",)),
            ],
            0.01,
        )
    )
    assert rows["method"] == ["E, called a gap", "A, called a gap", "A, named first"]
    assert rows["sbi, MMD of cells, p < 0.01"] == ["1 of 2, 50 % (9 to 91)", "2 of 2, 100 % (34 to 100)", ""]
    assert rows["sbi, log-prob of cells, beyond all of E"][:2] == [
        "0 of 2, 0 % (0 to 66)",
        "1 of 2, 50 % (9 to 91)",
    ]
    assert rows["largest of distortions, p < 0.01"] == rows["sbi, MMD of cells, p < 0.01"]
    assert rows["cosine of the raw residual"] == ["always", "", "1 of 2, 50 % (9 to 91)"]
    assert rows["arctrack"] == [
        "1 of 2, 50 % (9 to 91)",
        "2 of 2, 100 % (34 to 100)",
        "1 of 2, 50 % (9 to 91)",
    ]


def test_what_a_method_fails_on_counts_as_wrong():
    problem = {"problem": "ValueError: nothing"}
    failed = [
        Judged(Case("1", tier, effects, Answer(FAILED)), problem, is_diagnosed=True)
        for tier, effects in (("E", ()), ("A", ("gamma",)))
    ]
    rows = rows_of(table(failed, 0.01))
    for method in ("sbi, MMD of cells, p < 0.01", "sbi, MMD of cells, beyond all of E", "arctrack"):
        assert [cell.split(",")[0] for cell in rows[method][:2]] == ["1 of 1", "0 of 1"]


def test_a_sample_is_drawn_without_the_labels(tmp_path):
    seals = {f"{n:04d}": {"sha256": f"seal{n}", "again": False} for n in range(20)}
    (tmp_path / "sealed.json").write_text(json.dumps({"recordings": seals}))
    some = sampled(tmp_path, 5)
    assert len(some) == 5
    assert some.items() <= sampled(tmp_path, None).items()
    assert len(sampled(tmp_path, None)) == 20


@pytest.mark.slow
def test_sbi_calls_a_far_summary_a_gap_and_a_usual_one_none():
    pytest.importorskip("sbi", reason="sbi is not installed")
    rng = np.random.default_rng(6)
    drawn = rng.normal(size=(2300, 4)) @ rng.normal(size=(4, 4))
    usual, far = (
        sbi_says(drawn.mean(axis=0) + by, drawn, 0) for by in (np.zeros((1, 4)), np.full((1, 4), 20.0))
    )
    for test in ("log-prob", "MMD"):
        assert usual[test]["p"] > 0.1
        assert far[test]["p"] < 0.01
        assert far[test]["excess"] > usual[test]["excess"]
