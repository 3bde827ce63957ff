"""Diagnoses on the terminal: one on a screen, several as a table."""

from collections.abc import Iterator, Sequence

from rich import box
from rich.markup import escape
from rich.table import Table

from arctrack.cli import console
from arctrack.cli.replay_table import TAKEN_OVER
from arctrack.diagnose.applied_files import AppliedEffects
from arctrack.diagnose.diagnose import DiagnosisResult, TakenOver, summary_of
from arctrack.diagnose.diagnosis_files import ADDED_PAGE, REPORT_PAGE
from arctrack.diagnose.pages import applied_page, cost_words, unknown_words, words
from sim_to_real.diagnosis import Diagnosis, DiagnosisVerdict, RankedEffect


def print_one(done: Sequence[DiagnosisResult]) -> None:
    """Print one diagnosis: verdict, gap, parameters, ranking, what is open, what to measure next."""
    screen = console.tables()
    for diagnosed in done:
        console.warn(diagnosed.warnings)
        diagnosis = diagnosed.diagnosis
        harmless = cost_words.harmless(diagnosis, diagnosed.setup.tolerance.seam_mm)
        for text in filter(None, (words.model_test(diagnosis), harmless, words.headline(diagnosis))):
            screen.print(text, style="bold", markup=False, soft_wrap=True)
        withheld = words.withheld(diagnosis, diagnosed.job.without)
        for text in filter(None, (words.how_far(diagnosis), withheld, _seam(diagnosed))):
            screen.print(text, markup=False, soft_wrap=True)
        lines = list(_lines(diagnosis))
        width = max((len(name) for name, _ in lines), default=0)
        for name, text in lines:
            screen.print(f"[bold]{escape(name):<{width}}[/bold]  ", end="")
            screen.print(text, markup=False, soft_wrap=True)
        if diagnosis.ranking and diagnosis.verdict is not DiagnosisVerdict.NO_GAP:
            for table in _rankings(diagnosis):
                screen.print(table)
        console.say(f"report in {diagnosed.job.folder / REPORT_PAGE}")


def print_applied(applied: AppliedEffects) -> None:
    """Print how far effects that were added close the gap of frames that no fit saw."""
    console.say(applied_page.headline(applied))
    console.say(f"{applied_page.counted(applied)} The picture is in {applied.folder / ADDED_PAGE}")


def print_many(done: Sequence[DiagnosisResult | TakenOver]) -> None:
    """Print several diagnoses, a line each."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), caption_justify="left")
    table.add_column("recording", overflow="fold")
    table.add_column("verdict", no_wrap=True)
    for name in ("before σ", "after σ", "closed"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("effects", overflow="fold")
    taken_over = sum(isinstance(diagnosed, TakenOver) for diagnosed in done)
    if taken_over:
        table.caption = f"{TAKEN_OVER}: taken over from an earlier run, {taken_over} of {len(done)}"
    for diagnosed in done:
        summary = summary_of(diagnosed)
        console.warn(summary.warnings)
        mark = f" {TAKEN_OVER}" if isinstance(diagnosed, TakenOver) else ""
        table.add_row(
            escape(diagnosed.job.name) + mark,
            summary.verdict,
            words.number(summary.before),
            words.number(summary.after),
            words.percent(min(summary.closed, 1.0)),
            summary.named,
        )
    screen = console.tables()
    screen.print(table)
    for diagnosed in done:
        if withheld := summary_of(diagnosed).withheld:
            console.say(f"{diagnosed.job.name}: {withheld}")
        page = diagnosed.job.folder / REPORT_PAGE
        console.say(f"{diagnosed.job.name}: report in {page}")


def _seam(diagnosed: DiagnosisResult) -> str:
    return words.seam_sentence(diagnosed.diagnosis, diagnosed.setup.tolerance.seam_mm)


def _lines(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    """Yield names and texts of what else there is to say."""
    gap, where = diagnosis.gap, diagnosis.where
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        yield "residual", f"{words.number(gap.rms_dn[0])} DN rms"
    else:
        yield "residual", f"{' → '.join(words.number(value) for value in gap.rms_dn)} DN rms"
        parts = (f"{where.stage}: {words.PLACES.get(where.stage, '')}", words.follows(where))
        yield "where", "; ".join(part for part in parts if part)
        yield "evidence", words.because(diagnosis)
    for effect in diagnosis.effects:
        values = [f"{name} = {words.estimate(value)}" for name, value in effect.parameters.items()]
        values += [words.trend(effect.trend)] if effect.trend is not None else []
        yield (
            f"if {effect.id}" if diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS else effect.id,
            ", ".join(values),
        )
    if costs := cost_words.found_rows(diagnosis.costs):
        yield "cost", "; ".join(map(cost_words.in_words, costs))
    if diagnosis.verdict is DiagnosisVerdict.UNKNOWN and diagnosis.left_over is not None:
        yield "left over", words.left_over(*diagnosis.left_over)
    if bound := cost_words.largest_bound(diagnosis.costs):
        yield "at most", bound
    yield from unknown_words.described(diagnosis)
    if diagnosis.not_resolvable:
        # Pairs that cannot be told apart here; the page has them all.
        pairs = [" | ".join(pair) for pair in diagnosis.not_resolvable[:4]]
        more = len(diagnosis.not_resolvable) - len(pairs)
        yield "not told apart", "; ".join(pairs) + (f"; and {more} more pairs" if more else "")
    if diagnosis.next is not None:
        asked = diagnosis.next
        tells = f"tells {words.listed(asked.separates, 'from')}" if asked.separates else ""
        if asked.reason:
            tells = f"tells apart {words.listed(asked.separates, 'and')}: {asked.reason}"
        yield "record next", asked.experiment + (f" ({tells})" if tells else "")


def _rankings(diagnosis: Diagnosis) -> Iterator[Table]:
    """Yield the exclusive effects, and the random ones, each of which may be there besides."""
    exclusive = [candidate for candidate in diagnosis.ranking if not candidate.is_random]
    present = [candidate for candidate in words.random_ranking(diagnosis) if words.is_likely(candidate)]
    if exclusive:
        # Effects that are listed here; the page has more.
        yield _table("effect", words.ALONE, exclusive[:5])
    if present:
        yield _table("random effect", words.PRESENT, present)


def _table(effect: str, probability: str, ranking: Sequence[RankedEffect]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column(effect, no_wrap=True)
    table.add_column(f"closes {words.where_closed(ranking[0])}", justify="right", no_wrap=True)
    table.add_column(probability, justify="right")
    table.add_column("what it is")
    for candidate in ranking:
        table.add_row(
            candidate.id,
            words.percent(candidate.gap_closed),
            words.probability(candidate.confidence),
            escape(words.summary(candidate.id)),
        )
    return table
