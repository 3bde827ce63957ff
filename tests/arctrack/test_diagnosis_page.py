"""report.html: self-contained, and says what was found."""

import contextlib
import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import Page
from diagnosis_examples import GAMMA, GLARE, example
from made import small_setup

from arctrack.diagnose.diagnosis_files import report, write_numbers
from arctrack.diagnose.pages import cost_words, unknown_words, words
from arctrack.diagnose.pages.page import ADVICE, RECOMPUTE, advice, nice_limit, page, telling_frame
from arctrack.recording import Recording, read_recording
from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from sim_to_real.diagnosis import (
    NO_GAP,
    DiagnosisVerdict,
    EffectCost,
    Gap,
    Next,
    ParameterEstimate,
    RankedEffect,
    Reason,
    ReportedTrend,
    SeamShift,
)

VOID = {"meta", "img", "br", "rect"}


class Reader(HTMLParser):
    """Gathers a page's text and what it refers to, and sees that its tags fit."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.references += [value or "" for key, value in attrs if key in ("src", "href", "data", "action")]
        assert tag != "img" or "alt" in dict(attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text += data


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    assert reader.open == []
    reader.text = " ".join(reader.text.split())
    return reader


@pytest.fixture(scope="module")
def recording(simulated: Path) -> Recording:
    return read_recording(simulated)


@pytest.mark.parametrize("verdict", DiagnosisVerdict)
def test_the_page_is_self_contained(
    verdict: DiagnosisVerdict, seen_setup: Setup, recording: Recording
) -> None:
    html = page(example(verdict, seen_setup), recording)
    reader = read(html)
    assert reader.references
    assert all(reference.startswith("data:image/") for reference in reader.references)
    assert "url(" not in html
    assert "@import" not in html
    assert "<script" not in html
    assert "nan" not in re.findall(r"[a-z]+", reader.text)


@pytest.mark.slow
def test_the_page_can_be_read_at_every_width(
    seen_setup: Setup, recording: Recording, browser: Page, tmp_path: Path
) -> None:
    (tmp_path / "page.html").write_text(
        page(example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA | GLARE), recording)
    )
    browser.open(tmp_path / "page.html")
    browser.assert_readable()


@pytest.mark.slow
def test_what_effects_cost_stands_on_the_page(seen_setup: Setup, recording: Recording) -> None:
    text = read(page(example(DiagnosisVerdict.EFFECTS, seen_setup), recording)).text
    for said in (
        "gammathe response is not the stated power; the tracker loses the seam in 1 of 4 frames"
        "0.0010.001 to 0.0010.2120.200 to 0.221",
        "read_noisemore noise than stated; not computed",
        "The most that effects cost which were not found",
        "< 0.001≤ 0.014",
    ):
        assert said in text
    assert "No effect was found whose cost" not in text


@pytest.mark.parametrize("verdict", DiagnosisVerdict)
def test_a_gap_that_costs_nothing_says_so_first(
    verdict: DiagnosisVerdict, seen_setup: Setup, recording: Recording
) -> None:
    """Of no gap, and of a cause that is not known, nobody says so."""
    diagnosis = example(verdict, seen_setup)
    assert cost_words.harmless(diagnosis, 0.25) == ""
    small = SeamShift(0.01, 0.008, 0.0121, 0.01)
    names = ("gamma", "black_level")
    costs = tuple(EffectCost(name, SeamShift(0.0, 0.0, 0.0, 0.0), small, 4, 0, {}) for name in names)
    cheap = replace(diagnosis, costs=costs)
    expected = {
        DiagnosisVerdict.EFFECTS: "There is a gap, and it moves the seam by less than 0.02 mm.",
        # Either alternative may be there, both at worst.
        DiagnosisVerdict.AMBIGUOUS: "There is a gap, and it moves the seam by less than 0.03 mm.",
    }.get(verdict, "")
    assert cost_words.harmless(cheap, 0.25) == expected
    assert f"<h1>{expected}" in page(cheap, recording)
    assert cost_words.harmless(cheap, 0.1) == ""
    lost = replace(diagnosis, costs=(replace(costs[0], n_lost=1), costs[1]))
    assert cost_words.harmless(lost, 0.25) == ""
    if verdict is DiagnosisVerdict.AMBIGUOUS:
        assert cost_words.harmless(replace(diagnosis, costs=costs[:1]), 0.25) == ""


@pytest.mark.slow
def test_effects_are_named_with_numbers_and_cure(seen_setup: Setup, recording: Recording) -> None:
    reader = read(page(example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA | GLARE), recording))
    for text in (
        "2 effects explain the gap together: gamma (the response is not the stated power) and veiling_glare",
        "0.7400 ± 0.0074",
        ADVICE["gamma"],
        "The tracker's seam lies 0.21 mm from the seam that fits all images, less than the 0.25 mm that the "
        "weld can bear; with gamma and veiling_glare in the setup it lies 0.050 mm from it.",
        "predicted after, with gamma and veiling_glare",
        "two exposures, arc off. It tells gamma from exposure_drift",
        f"arctrack diagnose {recording.path} --apply",
        "wrong_material and fume",
        "[effects.gamma] gamma = 0.74",
    ):
        assert text in reader.text
    # Five pictures of a frame and their scale, the map and its scale, two curves.
    assert len(reader.references) == 10


@pytest.mark.slow
def test_an_effect_that_changes_is_said_to(seen_setup: Setup, recording: Recording) -> None:
    diagnosis = example(DiagnosisVerdict.EFFECTS, seen_setup, {"gamma": {"gamma": 0.8}})
    trend = ReportedTrend("time", "s", 0.1, 2.3, {"gamma": (0.7, 0.9)})
    grows = replace(diagnosis, effects=(replace(diagnosis.effects[0], trend=trend),))
    said = "it changes with time, 0.10 to 2.3 s: gamma from 0.700 to 0.900"
    assert said in page(grows, recording)
    assert said not in page(diagnosis, recording)
    assert "writes it, with the values half-way, into recording.toml" in page(grows, recording)
    assert "writes it into recording.toml" in page(diagnosis, recording)
    assert report(grows)["effects"][0]["trend"]["values"] == {"gamma": [0.7, 0.9]}


def test_what_effects_leave_is_said(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA)
    all_of_it = replace(found, gap=replace(found.gap, after=0.59, floor=0.3))
    assert words.headline(all_of_it).startswith("gamma explains the gap: ")
    assert words.how_far(all_of_it).endswith("of what exceeds the model's own error of 0.30 σ.")
    most = replace(found, gap=replace(found.gap, after=0.61, floor=0.3))
    assert words.headline(most).startswith("gamma explains most of the gap: ")
    assert words.how_far(most).endswith("due to the effect's form, which the catalogue simplifies.")


def test_a_gap_that_only_frames_held_out_show_is_said(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.UNKNOWN, seen_setup)
    assert words.headline(found).endswith("that no effect of the catalogue explains.")
    no_gap = replace(found, reasons=(Reason(NO_GAP, (), 0.0, 0.0, 0.99),))
    assert "in frames held out, though no gap is likeliest" in words.headline(no_gap)


def test_effects_beside_something_unknown_are_said(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA)
    gap = replace(found.gap, before=3.0, after=1.2, floor=0.3, closed=2.0 / 3.0, ci95=(0.6, 0.7))
    beside = replace(found, verdict=DiagnosisVerdict.UNKNOWN, gap=gap)
    assert words.headline(beside) == (
        f"gamma ({words.summary('gamma')}) beside something unknown: gamma closes 67 % of the gap of 3.0 σ."
    )
    gamma = beside.effects[0]
    two = replace(gamma, share=0.75), replace(gamma, id="fume", share=0.25)
    shares = "gamma closes 50 % and fume closes 17 % of the gap of 3.0 σ."
    assert words.headline(replace(beside, effects=two)).endswith(f" beside something unknown: {shares}")
    small = replace(beside, gap=replace(gap, before=0.2, closed=math.nan))
    assert words.headline(small).endswith(" beside something unknown, in a gap of 0.20 σ.")
    assert "closes 67 % (60 to 70 %) of what exceeds" in words.how_far(beside)
    assert words.how_far(beside).endswith("The rest is unknown.")
    assert advice(beside)[0].startswith("gamma: ")


def test_an_effect_below_the_floor_is_told_by_its_pattern(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA)
    small = replace(found, gap=replace(found.gap, before=0.2, after=0.1, floor=0.3, closed=math.nan))
    assert words.how_far(small).endswith(
        "from 0.20 σ to 0.10 σ. Both are within the model's own error of 0.30 σ, but that error hardly has "
        "the pattern of gamma."
    )


def test_what_comes_nearest_is_said_though_it_is_not_named(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.UNKNOWN, seen_setup, GAMMA)
    nearer, farther = (
        replace(found, gap=replace(found.gap, before=3.0, after=after, floor=0.3)) for after in (1.0, 3.2)
    )
    shrinks = words.how_far(nearer)
    assert shrinks.startswith("With gamma the gap in the images shrinks from 3.0 σ to 1.0 σ.")
    assert shrinks.endswith("That is too little for a cause.")
    nothing = words.how_far(farther)
    assert nothing.startswith("The best single effect, gamma, closes 22 % of it in bins.")
    assert words.how_far(replace(nearer, after_with=())) == nothing


@pytest.mark.slow
def test_no_page_says_that_no_effect_helps_above_one_that_does(
    seen_setup: Setup, recording: Recording
) -> None:
    found = example(DiagnosisVerdict.UNKNOWN, seen_setup, GAMMA)
    ranking = (
        RankedEffect("gamma", 0.6, 0.01),
        RankedEffect("pose_delay", 0.1, 0.07),
        RankedEffect("fume", 0.0, -0.01),
    )
    some = page(replace(found, ranking=ranking, after_with=()), recording)
    assert "The best single effect, pose_delay, closes 7 % of it in bins." in some
    assert "<b>7 %</b><span>of the gap in bins closed by the best effect, pose_delay</span>" in some
    assert "No effect of the catalogue makes it smaller" not in some
    assert "0 % of the gap" not in some
    none = page(replace(found, ranking=ranking[2:], after_with=()), recording)
    assert "No effect of the catalogue makes it smaller" in none
    assert "of the gap in bins closed" not in none


@pytest.mark.slow
def test_a_seam_that_the_gap_does_not_move_is_not_said_to_be_mended(
    seen_setup: Setup, recording: Recording
) -> None:
    found = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA)
    stays = replace(found, gap=replace(found.gap, seam_mm=(0.0214, 0.0211)))
    text = read(page(stays, recording)).text
    assert "The gap does not move the seam point: the tracker's seam lies 0.021 mm from" in text
    assert "with and without gamma, less than the 0.25 mm that the weld can bear" in text
    assert "of the gap in single pixels closed" in text
    same = "<b>0.021 mm</b><span>error of the seam point, before and after</span>"
    assert same in page(stays, recording)
    assert "<b>0.21 → 0.050 mm</b><span>error of the seam point</span>" in page(found, recording)
    unknown = example(DiagnosisVerdict.UNKNOWN, seen_setup, GAMMA)
    assert words.seam_sentence(unknown, 0.25).endswith("the true error may be larger.")


@pytest.mark.slow
def test_probabilities_of_one_table_are_of_effects_that_exclude_each_other(
    seen_setup: Setup, recording: Recording
) -> None:
    found = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA)
    html = page(found, recording)
    tables = re.findall(r"<table>.*?</table>", html, re.DOTALL)
    (exclusive,) = (table for table in tables if "<th>effect</th><th>closes in bins</th>" in table)
    (random,) = (
        table for table in tables if "<th>random effect</th><th>closes in single pixels</th>" in table
    )
    assert "read_noise" not in exclusive
    assert "read_noise" in random
    assert "it alone</th>" in exclusive
    assert "is there</th>" in random
    shares = [int(share) for share in re.findall(r'<td class="n">(\d+) %</td></tr>', exclusive)]
    assert shares[0] == 90
    assert sum(shares) <= 100
    assert "these probabilities do not add up to 100 %" in read(html).text


def test_what_no_quantity_explains_is_said_and_not_drawn(seen_setup: Setup, recording: Recording) -> None:
    found = example(DiagnosisVerdict.UNKNOWN, seen_setup)
    none = replace(found.where, covariates=tuple(replace(c, r2=0.02) for c in found.where.covariates))
    text = words.follows(none)
    assert text == (
        "no single quantity explains more than 2 % of it; a pattern fixed in the image explains 36 % of it"
    )
    assert text in read(page(replace(found, where=none), recording)).text
    assert "what differs along" not in page(replace(found, where=none), recording)
    assert "what differs along" in page(found, recording)
    assert words.follows(found.where) == "it goes with grey level (81 %) and direction of the weave (14 %)"


def test_the_likeliest_hypothesis_is_held_against_the_next(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA)
    assert words.because(found) == "gamma 340 nats; next unknown: sensor, grey level 310 nats"
    assert words.because(example(DiagnosisVerdict.NO_GAP, seen_setup)) == "no gap; next gamma −2.0 nats"
    assert words.because(replace(found, reasons=())) == ""


@pytest.mark.slow
def test_what_is_open_is_said(seen_setup: Setup, recording: Recording) -> None:
    ambiguous = read(page(example(DiagnosisVerdict.AMBIGUOUS, seen_setup), recording))
    assert "cannot tell what causes it: gamma (the response is not the stated power) or bl" in ambiguous.text
    assert f"If it is black_level: {ADVICE['black_level']}" in ambiguous.text
    unknown = read(page(example(DiagnosisVerdict.UNKNOWN, seen_setup, GLARE), recording, ["veiling_glare"]))
    assert "no effect of the catalogue explains" in unknown.text
    assert "Left out of the catalogue: veiling_glare" in unknown.text
    function = "a free function of angle off the mirror direction that multiplies the arc's light"
    assert f"Beyond the catalogue, {function} would close 62 % more of it." in unknown.text
    assert "What it may be" in ambiguous.text
    assert "What is wrong" not in ambiguous.text
    assert "predicted after" not in unknown.text
    assert "unknown: sensor, grey level340 natsthe most> 99 %" in unknown.text
    assert "veiling_glare310 nats30 nats behind< 1 %" in unknown.text
    assert "By evidence: optics (96 %) and timing (4 %)." in unknown.text
    assert "By evidence" not in ambiguous.text
    for reader in (ambiguous, unknown):
        assert "--apply" not in reader.text
    no_gap = read(page(example(DiagnosisVerdict.NO_GAP, seen_setup), recording))
    assert "No gap: the recording agrees" in no_gap.text
    assert "predicted after" not in no_gap.text


def test_a_name_is_no_markup(seen_setup: Setup, recording: Recording) -> None:
    odd = replace(recording, path=recording.path.parent / "<b> & co")
    html = page(example(DiagnosisVerdict.EFFECTS, seen_setup), odd)
    assert "&lt;b&gt; &amp; co" in html
    assert "arctrack diagnose &#39;" in html


def test_a_diagnosis_without_held_out_frames_has_a_page(seen_setup: Setup, recording: Recording) -> None:
    diagnosis = example(DiagnosisVerdict.UNKNOWN, seen_setup)
    none = diagnosis.predicted.before[:0]
    empty = replace(diagnosis.predicted, frames=np.empty(0, np.int64), before=none, after=none)
    where = replace(diagnosis.where, covariates=(), z=np.full_like(diagnosis.where.z, np.nan))
    reader = read(page(replace(diagnosis, predicted=empty, where=where, unknown=None), recording))
    assert reader.references == []


@pytest.mark.slow
def test_the_same_diagnosis_makes_the_same_page(recording: Recording) -> None:
    setup = small_setup()
    assert page(example(DiagnosisVerdict.EFFECTS, setup), recording) == page(
        example(DiagnosisVerdict.EFFECTS, setup), recording
    )


def test_the_python_on_the_page_computes_the_gap(
    seen_setup: Setup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diagnosis = example(DiagnosisVerdict.EFFECTS, seen_setup)
    write_numbers(diagnosis, tmp_path)
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(RECOMPUTE, {})
    names, values = zip(*(line.split() for line in printed.getvalue().splitlines()), strict=True)
    assert names == ("before", "after")
    expected = [diagnosis.gap.before, diagnosis.gap.after]
    assert [float(value) for value in values] == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_the_frame_that_tells_most_is_shown(seen_setup: Setup) -> None:
    predicted = example(DiagnosisVerdict.EFFECTS, seen_setup).predicted
    only_second = predicted.after.copy()
    only_second[[0, 2, 3]] = predicted.before[[0, 2, 3]]
    assert telling_frame(replace(predicted, after=only_second, variance_after=predicted.variance)) == 1


def test_the_ends_of_a_scale() -> None:
    values = np.linspace(-6.2, 6.2, 1001, dtype=np.float32)
    assert nice_limit(values, 1.0) == 8.0
    assert nice_limit(0.01 * values, 1.0) == 1.0
    assert nice_limit(np.full(3, np.nan, np.float32), 3.0) == 3.0


def test_there_is_advice_on_every_effect() -> None:
    assert set(ADVICE) == set(REGISTRY)


@pytest.mark.parametrize(
    ("verdict", "resolves", "line"),
    [
        (DiagnosisVerdict.EFFECTS, True, "Record next: dark frames. It tells gamma from fume."),
        (DiagnosisVerdict.EFFECTS, False, "No other frames would tell gamma from fume. Add dark frames."),
        (
            DiagnosisVerdict.UNKNOWN,
            False,
            "The likeliest effect, gamma, does not explain the gap by itself. To measure it, add dark "
            "frames.",
        ),
    ],
)
def test_what_to_measure_next(
    verdict: DiagnosisVerdict, resolves: bool, line: str, seen_setup: Setup
) -> None:
    asks = replace(example(verdict, seen_setup), next=Next("dark frames", ("gamma", "fume"), resolves))
    assert advice(asks)[-1] == line


def test_numbers_in_words() -> None:
    assert words.estimate(ParameterEstimate(-1.23456, 0.0123, "mm")) == "−1.235 ± 0.012 mm"
    assert words.estimate(ParameterEstimate(30512.0, 1234.0, "e-")) == "30512 ± 1234 e-"
    assert words.estimate(ParameterEstimate(0.5, float("nan"), "")) == "0.500"
    assert words.estimate(ParameterEstimate(float("nan"), 0.1, "")) == "–"
    assert words.as_factor("c2_ln", ParameterEstimate(0.5, 0.1, "")) == "× 1.65"
    assert words.as_factor("gamma", ParameterEstimate(0.5, 0.1, "")) == ""
    assert words.number(float("inf")) == "–"
    assert [words.number(value) for value in (123.4, 18.2, -3.98, 0.0)] == ["123", "18", "−4.0", "0.0"]
    gap = Gap(4.0, 0.0, 0.2, 1.05, (1.04, 1.06), (5.0, 1.0), (0.1, 0.0), 1.0)
    assert words.closed_share(gap) == "100 %"
    assert words.closed_share(replace(gap, closed=0.93, ci95=(0.9, 0.95))) == "93 % (90 to 95 %)"
    assert words.closed_share(replace(gap, closed=math.nan, ci95=(math.nan, math.nan))) == "–"
    assert words.probability(0.9999) == "> 99 %"
    assert words.probability(0.001) == "< 1 %"
    assert words.probability(float("nan")) == "–"
    assert words.free_function("row, column adds") == (
        "a free function of row and column that adds to the image"
    )
    assert words.free_function("row") == "a free function of row"
    assert words.listed(["a", "b", "c"], "or") == "a, b or c"


def test_no_gap_above_the_floor_is_not_said_to_be_below_it(seen_setup: Setup) -> None:
    found = example(DiagnosisVerdict.NO_GAP, seen_setup)
    above, below = (
        replace(found, gap=replace(found.gap, before=before, floor=0.22)) for before in (0.42, 0.2)
    )
    assert "by 0.42 σ, more than the model's own error of 0.22 σ." in words.how_far(above)
    assert words.how_far(below) == (
        "The images differ from the model by 0.20 σ, within the model's own error of 0.22 σ."
    )


def test_an_unknown_cause_is_told_in_sentences_with_numbers(seen_setup: Setup) -> None:
    told = dict(unknown_words.described(example(DiagnosisVerdict.UNKNOWN, seen_setup)))
    for heading, part in (
        ("it is like", "arc light by distance (stage medium), the likeliest single term by 97 %: it"),
        ("it is like", "explains 80 % of what is left. Next come light by place (40 %)."),
        (
            "it lies",
            "mostly between rows 20 and 60 px, and columns 40 and 80 px; on the part 12 to 18 mm along",
        ),
        ("it comes", "half of it in frames 2 and 7, of 9 that were fitted."),
        ("it goes with", "distance from the arc, which explains 62 % of it: the arc's light, about its mean"),
        ("it goes with", "from −10 ± 2.0 % at 60.0 mm to 10 ± 2.0 % at 20.0 mm"),
        ("near to it", "gamma alone leaves 78 %, 2.3 σ of 3.0 σ in bins; black_level alone leaves 82 %"),
        ("the seam", "0.31 mm to the left of its stated line and 1.2 mm below it; a laser sheet 0.44 mm off"),
    ):
        assert part in told[heading]
    assert unknown_words.described(example(DiagnosisVerdict.EFFECTS, seen_setup)) == []


def test_what_is_even_is_said_to_be(seen_setup: Setup) -> None:
    diagnosis = example(DiagnosisVerdict.UNKNOWN, seen_setup)
    even = replace(
        diagnosis.unknown, spread=0.24, frames=(1, 2, 3, 4), curve=None, seam_off_mm=(math.nan, math.nan)
    )
    told = dict(unknown_words.described(replace(diagnosis, unknown=even)))
    assert told["it lies"].startswith("all over the image")
    assert told["it comes"] == "in all frames that were fitted alike."
    assert told["it goes with"] == "no single quantity."
    assert "the seam" not in told
    few = replace(diagnosis, unknown=replace(even, n_frames=1))
    assert dict(unknown_words.described(few))["it comes"] == "too few frames to say when: 1 fitted."


@pytest.mark.slow
def test_the_page_of_an_unknown_cause_can_be_read_at_every_width(
    seen_setup: Setup, recording: Recording, browser: Page, tmp_path: Path
) -> None:
    diagnosis = example(DiagnosisVerdict.UNKNOWN, seen_setup)
    asked = Next("the same run again", ("one thing", "another"), True, "what comes again is fixed", 0.97)
    html = page(replace(diagnosis, next=asked), recording)
    assert (
        "Record next: the same run again. It tells apart one thing and another: what comes again is fixed."
        in html
    )
    assert "What the unknown is like" in html
    (tmp_path / "page.html").write_text(html)
    browser.open(tmp_path / "page.html")
    browser.assert_readable()
