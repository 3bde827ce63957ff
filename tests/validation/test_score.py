"""Scores of answers made by hand, all of whose rates are known; bounds against another derivation."""

import math

import numpy as np
import pytest

from validation.blind_check.case import FAILED, Answer, Case
from validation.blind_check.score import Z95, Rate, expected_calibration_error, score

ONE = {
    "stage": "sensor",
    "gap_before": 3.0,
    "gap_floor": 0.5,
    "gap_closed": 0.9,
    "wall_s": 30.0,
    "cpu_s": 20.0,
}


def sure(*named, ranked=(), confidence=0.95, **other):
    """An answer that names effects for sure."""
    ranked = (*named, *ranked)
    closes = {name: 0.8 - 0.1 * n for n, name in enumerate(ranked)}
    return Answer("effects", named, ranked, confidence, closes, **(ONE | other))


def silent(verdict, ranked=(), **other):
    """An answer that names nothing."""
    return Answer(verdict, (), ranked, 0.4, **(ONE | other))


def failed(problem="ValueError: no frame has a pose"):
    return Answer(FAILED, problem=problem)


def likeness(*names):
    return tuple((name, 0.9 - 0.1 * n) for n, name in enumerate(names))


PAIR = frozenset({frozenset({"gamma", "exposure_drift"})})

A_CASES = [
    # Right, and unknown once it is withheld.
    Case("01", "A", ("gamma",), sure("gamma"), likeness("gamma", "fume"), silent("unknown")),
    # Right; once withheld, an effect is named that was declared not to be told apart.
    Case(
        "02",
        "A",
        ("gamma",),
        sure("gamma", unresolvable=PAIR),
        likeness("fume", "gamma"),
        sure("exposure_drift"),
    ),
    # Right; once withheld, another is named.
    Case(
        "03",
        "A",
        ("fume",),
        sure("fume", stage="medium", gap_before=1.0),
        likeness("spatter"),
        sure("veiling_glare"),
    ),
    # Wrong, the hidden one is third; what was withheld was not what is hidden.
    Case(
        "04",
        "A",
        ("defocus",),
        sure("gamma", ranked=("fume", "defocus"), confidence=0.92, stage="optics"),
        likeness("gamma", "fume", "spatter", "defocus"),
        silent("unknown"),
    ),
    # Wrong, but one of a pair declared not to be told apart.
    Case(
        "05",
        "A",
        ("exposure_drift",),
        sure("gamma", unresolvable=PAIR, gap_before=1.0),
        likeness("exposure_drift"),
        silent("no_gap"),
    ),
    # Ambiguous with the right one first: no answer is withheld.
    Case(
        "06",
        "A",
        ("gamma",),
        Answer("ambiguous", ("gamma",), ("gamma", "black_level"), 0.55, **(ONE | {"gap_closed": 0.7})),
        likeness("gamma"),
    ),
    Case("07", "A", ("spatter",), silent("unknown", ("spatter", "fume"), stage="medium"), likeness("fume")),
    Case("08", "A", ("vignetting",), silent("no_gap", ("vignetting",), gap_before=0.6), likeness("fume")),
    Case("09", "A", ("gamma",), failed(), ()),
]
OTHERS = [
    Case("10", "C", ("gamma",), sure("gamma"), likeness("gamma")),
    Case("11", "C", ("gamma",), silent("unknown", ("black_level", "gamma")), likeness("gamma")),
    Case("12", "D", ("gamma", "fume"), sure("fume", "gamma"), likeness("gamma", "fume", "spatter")),
    Case("13", "D", ("gamma", "fume"), sure("fume"), likeness("gamma", "spatter", "fume")),
    Case("14", "D", ("gamma", "fume"), sure("fume", "gamma", "spatter"), likeness("spatter")),
    Case("15", "E", (), silent("no_gap", ("gamma",)), likeness("gamma")),
    Case("16", "E", (), silent("unknown", ("gamma",)), likeness("gamma")),
    Case("17", "E", (), sure("gamma"), likeness("gamma")),
    Case("18", "E", (), failed("not diagnosed")),
]


RAISED = {"experiment": "the torch raised by 2 mm", "separates": ("gamma", "fume")}
ASKED = [
    # Ambiguous; then named for sure.
    Case(
        "21",
        "A",
        ("gamma",),
        silent("ambiguous", alike=("fume", "gamma"), **RAISED),
        longer=sure("gamma", "spatter"),
    ),
    # Unknown; then named, but not for sure.
    Case("22", "A", ("fume",), silent("unknown", **RAISED), longer=Answer("ambiguous", ("fume",))),
    # Named for sure, but another looks the same; then the other is named.
    Case("23", "C", ("gamma",), sure("gamma", **RAISED), longer=sure("fume", "gamma")),
    Case("24", "C", ("gamma",), sure("fume", **RAISED), longer=sure("gamma")),
    # Neither of the two is hidden.
    Case("25", "A", ("spatter",), silent("unknown", **RAISED), longer=sure("spatter")),
    # One of the two is hidden, then both are named; then only one.
    Case("26", "D", ("fume", "defocus"), silent("unknown", **RAISED), longer=sure("defocus", "fume")),
    Case("27", "D", ("fume", "defocus"), silent("unknown", **RAISED), longer=sure("fume")),
    # Not measured; measured in vain; nothing asked for.
    Case("28", "D", ("gamma", "defocus"), silent("unknown", **RAISED)),
    Case("29", "A", ("gamma",), silent("unknown", **RAISED), longer=failed()),
    Case("30", "A", ("gamma",), sure("gamma")),
    Case("31", "E", (), silent("unknown", **RAISED)),
    # A witness is asked for; ambiguous, but the hidden effect is not in the set.
    Case("32", "A", ("gamma",), silent("unknown", **(RAISED | {"experiment": "a board, as a witness"}))),
    Case("33", "C", ("gamma",), silent("ambiguous", alike=("fume",), **RAISED), longer=sure("fume")),
]


@pytest.fixture(scope="module")
def scores():
    return score(A_CASES + OTHERS, "ABCDE")


@pytest.mark.parametrize(
    ("name", "right", "of", "cosine"),
    [
        ("top1_A", 4, 9, (3, 9)),
        ("top1_sure_A", 4, 9, (3, 9)),
        ("top3_A", 6, 9, (4, 9)),
        ("alone_A", 3, 9, (3, 9)),
        ("best_A", 6, 9, (3, 9)),
        # The fifth is left out.
        ("top1_resolvable_A", 4, 8, (2, 8)),
        # The third, the fifth and the eighth have small gaps.
        ("top1_clear_A", 3, 6, (2, 6)),
        ("detected_clear_A", 5, 6, (6, 6)),
        ("stage_A", 7, 9, (5, 9)),
        ("false_unknown_A", 2, 9, (0, 9)),
        ("unknown_B", 1, 2, (0, 2)),
        ("unknown_clear_B", 1, 1, (0, 1)),
        ("apart_B", 1, 3, (0, 0)),
        ("wrongly_withheld_B", 2, 9, (0, 0)),
        ("not_withheld_B", 4, 9, (0, 0)),
        ("top1_C", 1, 2, (2, 2)),
        ("top3_C", 2, 2, (2, 2)),
        ("false_unknown_C", 1, 2, (0, 2)),
        ("wrong_sure_B", 0, 2, (0, 0)),
        ("exact_D", 1, 3, (1, 3)),
        ("exact_open_D", 1, 3, (1, 3)),
        ("no_wrong_D", 2, 3, (1, 3)),
        ("top1_D", 3, 3, (2, 3)),
        ("detected_D", 3, 3, (3, 3)),
        ("false_alarm", 3, 4, (4, 4)),
        ("false_name", 2, 4, (4, 4)),
    ],
)
def test_rates_are_those_counted_by_hand(scores, name, right, of, cosine):
    found = {one.id: one for one in scores.rates}[name]
    assert (found.rate.right, found.rate.of) == (right, of)
    assert (found.cosine.right, found.cosine.of) == cosine


def test_the_next_experiment_is_counted_where_it_could_tell():
    found = {one.id: one for one in score(ASKED, "ACDE").rates}
    assert found["next_resolves"].rate == Rate(3, 8)
    assert found["next_resolves"].tiers == "ACD"
    assert found["next_resolves_open"].rate == Rate(2, 6)
    assert found["next_resolves_set"].rate == Rate(1, 1)
    assert found["next_witness"].rate == Rate(1, 11)
    assert found["next_asked"].rate == Rate(11, 12)
    assert found["next_neither"].rate == Rate(1, 11)
    assert found["next_missing"].rate == Rate(1, 11)
    assert ("29 then the torch raised by 2 mm", "ValueError: no frame has a pose") in score(
        ASKED, "ACDE"
    ).failures
    alone = {one.id: one for one in score(ASKED, "AE").rates}
    assert alone["next_resolves"].rate == Rate(1, 3)
    assert alone["next_resolves"].tiers == "A"
    assert not [one.id for one in score(ASKED, "E").rates if one.id.startswith("next")]


def test_in_a_plain_run_a_set_with_the_hidden_effect_is_no_wrong_answer():
    cases = [
        Case("41", "F", ("gamma",), sure("gamma"), likeness("gamma")),
        Case(
            "42",
            "F",
            ("gamma",),
            Answer("ambiguous", ("fume",), confidence=0.5, alike=("fume", "gamma")),
            likeness("fume"),
        ),
        Case(
            "43", "F", ("gamma",), Answer("ambiguous", ("fume",), confidence=0.5, alike=("fume", "spatter"))
        ),
        Case("44", "F", ("gamma",), sure("fume", "gamma")),
        Case("45", "F", ("gamma",), silent("no_gap")),
        Case("46", "F", ("gamma",), failed()),
    ]
    found = {one.id: one.rate for one in score(cases, "F").rates}
    assert found["top1_F"] == Rate(1, 6)
    assert found["in_set_F"] == Rate(2, 6)
    assert found["wrong_F"] == Rate(1, 6)
    assert found["no_gap_F"] == Rate(1, 6)


def beside_unknown(*named, confidence=0.97, **other):
    """An answer that names effects beside something unknown."""
    return Answer("unknown", named, named, confidence, **(ONE | {"gap_closed": 0.6} | other))


WIDE = [
    # Right for sure, and unknown once it is withheld; then a wrong one for sure, with 0.99 and with 0.94.
    Case("51", "G", ("gamma",), sure("gamma"), likeness("gamma"), silent("unknown")),
    Case("52", "G", ("gamma",), sure("gamma"), likeness("fume"), sure("fume", confidence=0.99)),
    Case("53", "G", ("gamma",), sure("gamma"), likeness("fume"), sure("fume", confidence=0.94)),
    # Right beside something unknown; a wrong one next to it; a right one, but the gap stays open.
    Case("54", "G", ("gamma",), beside_unknown("gamma"), likeness("fume")),
    Case("55", "G", ("gamma",), beside_unknown("gamma", "fume"), likeness("gamma")),
    Case("56", "G", ("gamma",), sure("gamma", gap_closed=0.89), likeness("gamma"), beside_unknown("fume")),
    # All three; all three beside something unknown; two of three; one that is not hidden among them; none.
    Case("61", "H", ("gamma", "fume", "spatter"), sure("fume", "spatter", "gamma")),
    Case("62", "H", ("gamma", "fume", "spatter"), beside_unknown("gamma", "spatter", "fume")),
    Case("63", "H", ("gamma", "fume", "spatter"), sure("gamma", "fume", gap_closed=0.95)),
    Case("64", "H", ("gamma", "fume", "spatter"), sure("gamma", "defocus")),
    Case("65", "H", ("gamma", "fume", "spatter"), silent("unknown")),
    Case("66", "H", ("gamma", "fume", "spatter"), Answer("ambiguous", ("gamma", "defocus"), **ONE)),
    Case("71", "I", (), silent("no_gap")),
    Case("72", "I", (), sure("hand_eye")),
]


@pytest.mark.parametrize(
    ("name", "right", "of"),
    [
        ("top1_G", 6, 6),
        ("top1_sure_G", 4, 6),
        ("alone_G", 4, 6),
        ("unknown_BG", 2, 4),
        # The third is not sure enough, the sixth names an effect beside something unknown.
        ("wrong_sure_BG", 1, 4),
        ("not_withheld_BG", 2, 6),
        ("exact_H", 1, 6),
        ("exact_open_H", 2, 6),
        ("no_wrong_H", 3, 4),
        ("top1_H", 5, 6),
        ("detected_H", 6, 6),
        ("false_alarm_I", 1, 2),
        ("false_name_I", 1, 2),
        # Of fourteen first answers and four withheld ones.
        ("unclosed", 1, 18),
        ("false_second", 2, 12),
    ],
)
def test_rates_of_a_world_that_moves_on(name, right, of):
    found = {one.id: one for one in score(WIDE, "BGHI").rates}
    assert found[name].rate == Rate(right, of)
    assert "unknown_B" not in found
    assert found["unknown_BG"].tiers == "B of G"
    assert found["false_second"].tiers == "GH"


def test_calibration_with_the_cause_and_with_it_withheld():
    scores = score(WIDE, "BGHI")
    found = {one.id: one for one in scores.figures}
    # Of G and I: 0.95 right four times, wrong once; 0.97 right twice. Of H none.
    assert found["calibration_error"].of == 7
    assert found["calibration_error"].value == pytest.approx(abs(6 - 5 * 0.95 - 2 * 0.97) / 7)
    assert found["calibration_error"].tiers == "GI"
    # Withheld: 0.99, 0.94 and 0.97, none of which can be right.
    assert found["calibration_error_withheld"].of == 3
    assert found["calibration_error_withheld"].value == pytest.approx((0.99 + 0.94 + 0.97) / 3)
    assert found["calibration_error_all"].of == 10
    assert found["calibration_error_all"].value == pytest.approx((9.59 - 6) / 10)
    curve = {(one.low, one.high): one for one in scores.calibration}
    assert curve[0.9, 0.95].in_catalogue == Rate(4, 5)
    assert curve[0.95, 0.99].in_catalogue == Rate(2, 2)
    assert curve[0.9, 0.95].withheld == Rate(0, 1)
    assert curve[0.95, 0.99].withheld == Rate(0, 2)
    assert sum(one.in_catalogue.of + one.withheld.of for one in scores.calibration) == 10


def test_a_cause_that_was_not_the_one_withheld_is_no_claim_of_an_unknown():
    wrong = Case("01", "G", ("gamma",), sure("fume"), again=sure("gamma", confidence=1.0))
    none = Case("02", "G", ("gamma",), sure("fume", confidence=0.0))
    scores = score([wrong, none], "BG")
    assert sum(one.withheld.of for one in scores.calibration) == 0
    assert scores.calibration[0].in_catalogue == Rate(0, 1)
    assert {one.id: one.rate for one in scores.rates}["wrong_sure_BG"] == Rate(0, 0)


def test_without_experiments_nothing_is_measured(scores):
    found = {one.id: one.rate for one in scores.rates}
    assert found["next_resolves"] == found["next_resolves_open"] == Rate(0, 0)
    assert found["next_asked"] == Rate(0, 14)


def test_figures(scores):
    found = {one.id: one for one in scores.figures}
    # Clear gaps in A: 1, 2 and 4 close 0.9, the ambiguous one 0.7, the unknown 0.9.
    assert found["gap_closed"].of == 5
    assert found["gap_closed"].value == pytest.approx(0.9)
    # Only the fourth's best candidate is not the hidden one: 0.8 over 0.6.
    assert found["closed_over_true"].of == 3
    assert found["closed_over_true"].value == pytest.approx(1.0)
    assert found["closed_over_true"].bounds[1] == pytest.approx(0.8 / 0.6, abs=0.2)
    # Named in A, C, E: 0.95 right in 01 02 03 10, wrong in 05 17, 0.92 wrong in 04; 0.55 right in 06.
    off = abs(4 - (6 * 0.95 + 0.92)) + abs(1 - 0.55)
    assert found["calibration_error"].of == 8
    assert found["calibration_error"].value == pytest.approx(off / 8.0)
    assert found["wall_s"].of == 16
    assert found["wall_s"].value == pytest.approx(30.0)
    low, high = found["calibration_error"].bounds
    assert 0.0 <= low < off / 8.0 < high <= 1.0


def test_every_wrong_answer_and_every_failure_is_listed(scores):
    wrong = {one.name: one for one in scores.confusions}
    assert set(wrong) == {"04", "05", "07", "08", "09", "11", "13", "14", "16", "17", "18"}
    assert wrong["05"].unresolvable
    assert not wrong["04"].unresolvable
    assert wrong["04"].named == ("gamma",)
    assert scores.failures == (("09", "ValueError: no frame has a pose"), ("18", "not diagnosed"))


def test_an_effects_line(scores):
    (gamma,) = [one for one in scores.by_effect if (one.tier, one.effect) == ("A", "gamma")]
    assert (gamma.top1, gamma.cosine) == (Rate(3, 4), Rate(2, 4))
    assert gamma.verdicts == {"effects": 2, "ambiguous": 1, "unknown": 0, "no_gap": 0, FAILED: 1}


def test_a_missing_second_run_is_a_wrong_answer():
    case = Case("01", "A", ("gamma",), sure("gamma"), (), failed("not diagnosed"))
    found = score([case], "AB")
    rate = {one.id: one.rate for one in found.rates}
    assert rate["unknown_B"] == Rate(0, 1)
    assert found.failures == (("01 without gamma", "not diagnosed"),)


def test_an_effect_that_is_named_but_not_ranked_counts_as_first():
    answer = Answer("effects", ("read_noise",), ("fume", "gamma", "defocus"), 0.9, {"fume": 0.1}, **ONE)
    rate = {one.id: one.rate for one in score([Case("01", "A", ("read_noise",), answer)], "A").rates}
    assert rate["top1_A"] == rate["top3_A"] == rate["best_A"] == Rate(1, 1)


def test_scores_of_nothing():
    found = score([], "ABCDE")
    assert all(math.isnan(one.rate.share) for one in found.rates)
    assert all(math.isnan(one.value) for one in found.figures)


@pytest.mark.parametrize(("right", "of"), [(0, 5), (5, 5), (3, 10), (89, 90), (1, 1)])
def test_wilsons_bounds_solve_the_score_equation(right, of):
    # (p_hat - p)^2 = z^2 p (1 - p) / n, as a quadratic in p.
    p_hat, z2 = right / of, Z95**2
    roots = np.roots([1.0 + z2 / of, -2.0 * p_hat - z2 / of, p_hat**2])
    np.testing.assert_allclose(Rate(right, of).bounds, np.clip(np.sort(roots.real), 0.0, 1.0), atol=1e-9)


def test_the_calibration_error_of_known_confidences():
    # 0.8 and 0.6 in bins of their own, right in 8 of 10 and in 9 of 10.
    confidence = np.repeat([0.81, 0.65], 10)
    is_right = np.concatenate([np.arange(10) < 8, np.arange(10) < 9]).astype(float)
    assert expected_calibration_error(confidence, is_right) == pytest.approx(0.5 * (0.01 + 0.25))
    assert expected_calibration_error(np.ones(3), np.ones(3)) == pytest.approx(0.0)
    assert math.isnan(expected_calibration_error(np.empty(0), np.empty(0)))
