"""report.html: a recording's diagnosis on one self-contained page, to be read in two minutes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.diagnose.diagnosis_files import PREDICTED_NPZ, REPORT_JSON, WHERE_NPZ
from arctrack.diagnose.pages import pictures, words
from arctrack.diagnose.pages.advice import ADVICE
from arctrack.output import write_whole
from arctrack.printable import quoted
from arctrack.recording import Recording
from arctrack.report.template import environment
from noise_model.effects import REGISTRY
from sim_to_real.diagnosis import (
    Curve,
    Diagnosis,
    DiagnosisVerdict,
    NamedEffect,
    Next,
    RankedEffect,
    excluded_effects,
)

LABELS = {
    DiagnosisVerdict.NO_GAP: "no gap",
    DiagnosisVerdict.EFFECTS: "gap explained",
    DiagnosisVerdict.AMBIGUOUS: "ambiguous",
    DiagnosisVerdict.UNKNOWN: "unknown cause",
}

LOOK_FURTHER = (
    'See under "Where the gap lies" where it is and what it goes with. Check what was changed last: sensor, '
    "part or setup file."
)

RECOMPUTE = f"""\
import numpy as np

held_out = np.load("{PREDICTED_NPZ}")
for mean, variance in (("before", "variance"), ("after", "variance_after")):
    r = (held_out["recorded"] - held_out[mean]) / np.sqrt(held_out[variance])
    r = r[np.isfinite(held_out[variance])]
    print(mean, np.sqrt(max(np.mean(r**2) - 1.0, 0.0)))
"""
"""Python that computes the gap from the files that were written."""


@dataclass(frozen=True)
class EffectRow:
    """An effect in a table of the page: the share of the gap that it closes, and its probability in words."""

    id: str
    summary: str
    marked: bool
    closed: float
    confidence: str


@dataclass(frozen=True)
class Ranking:
    """A table of effects of one kind: the headings of its columns, and its rows."""

    kind: str
    closes: str
    probability: str
    rows: list[EffectRow]


def write_page(diagnosis: Diagnosis, recording: Recording, without: Sequence[str], path: Path) -> None:
    """Write the page to a file; `without` are the effects that the user left out of the search.

    Raises ArctrackError if it cannot be written.
    """
    write_whole(path, page(diagnosis, recording, without))


def page(diagnosis: Diagnosis, recording: Recording, without: Sequence[str] = ()) -> str:
    """Return the page, which needs no other file and no network."""
    pages = environment()
    pages.globals.update(words=words, Verdict=DiagnosisVerdict)
    return pages.get_template("diagnosis.html.j2").render(**_content(diagnosis, recording, without))


def advice(diagnosis: Diagnosis) -> list[str]:
    """Return the next steps, a line each."""
    lines = []
    if diagnosis.verdict in (DiagnosisVerdict.EFFECTS, DiagnosisVerdict.UNKNOWN):
        lines += [f"{effect.id}: {ADVICE[effect.id]}" for effect in diagnosis.effects]
    if diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS:
        lines += [f"If it is {name}: {ADVICE[name]}" for name in named_effects(diagnosis)]
    if diagnosis.verdict is DiagnosisVerdict.UNKNOWN:
        lines.append(LOOK_FURTHER)
    if diagnosis.next is not None:
        lines.append(_to_record(diagnosis.next, diagnosis.verdict))
    if not lines:
        lines.append("Nothing: the setup fits the recording.")
    return lines


def _to_record(measurement: Next, verdict: DiagnosisVerdict) -> str:
    separates = words.listed(measurement.separates, "from")
    if measurement.resolves:
        return f"Record next: {measurement.experiment}. It tells {separates}."
    if verdict is DiagnosisVerdict.UNKNOWN:
        likeliest = f"The likeliest effect, {measurement.separates[0]}, does not explain the gap by itself"
        return f"{likeliest}. To measure it, add {measurement.experiment}."
    return f"No other frames would tell {separates}. Add {measurement.experiment}."


def named_effects(diagnosis: Diagnosis) -> list[str]:
    """Return the effects that the verdict is about: those that it names, and those that fit equally well."""
    ambiguous = (name for ids in diagnosis.ambiguous_with for name in ids)
    return list(dict.fromkeys([*(effect.id for effect in diagnosis.effects), *ambiguous]))


def paste(effects: Sequence[NamedEffect]) -> str:
    """Return the tables that name effects in recording.toml."""
    tables = []
    for effect in effects:
        values = "".join(f"{name} = {float(f'{e.value:.6g}')!r}\n" for name, e in effect.parameters.items())
        tables.append(f"[effects.{effect.id}]\n{values}")
    return "\n".join(tables)


def _content(diagnosis: Diagnosis, recording: Recording, without: Sequence[str]) -> dict[str, Any]:
    setup, predicted = recording.setup, diagnosis.predicted
    shown = None
    if len(predicted.frames):
        shown = pictures.frame_pictures(predicted, pictures.telling_frame(predicted), setup.sensor)
    z, scale = None, None
    if np.isfinite(diagnosis.where.z).any():
        z, scale = pictures.residual_map(diagnosis.where.z)
    curves = [(curve, pictures.curve_picture(curve)) for curve in drawn_curves(diagnosis)]
    return {
        "diagnosis": diagnosis,
        "recording": recording,
        "excluded": excluded_effects(setup, without),
        "withheld": words.withheld(diagnosis, without),
        "label": LABELS[diagnosis.verdict],
        "seam": words.seam_sentence(diagnosis, setup.tolerance.seam_mm),
        "bears_mm": setup.tolerance.seam_mm,
        "advice": advice(diagnosis),
        "shown": shown,
        "is_after": shown is not None and shown.before != shown.after,
        "with_what": words.added(diagnosis),
        "map": z,
        "map_scale": scale,
        "curves": curves,
        "rankings": _rankings(diagnosis),
        "strata": _strata(diagnosis),
        "smallest": {name: diagnosis.smallest[name] for name in REGISTRY if name in diagnosis.smallest},
        "paste": paste(diagnosis.effects),
        "shrinks": words.shrinks(diagnosis),
        "best": words.best_alone(diagnosis),
        "same_seam": words.is_same_seam(*diagnosis.gap.seam_mm),
        "apply": f"arctrack diagnose {quoted(recording.path)} --apply",
        "recompute": RECOMPUTE,
        "files": (REPORT_JSON, WHERE_NPZ, PREDICTED_NPZ),
    }


def drawn_curves(diagnosis: Diagnosis) -> list[Curve]:
    """Return the covariates that explain enough of the residual for a picture; none without a gap."""
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        return []
    curves = [curve for curve in diagnosis.where.covariates if len(curve.centers)]
    # Covariates that are drawn at most; report.json has all of them.
    return [curve for curve in curves[:4] if curve.r2 >= words.MIN_R2]


def _rankings(diagnosis: Diagnosis) -> list[Ranking]:
    """Return a table of exclusive effects and one of random ones, which may be there besides."""
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        return []
    # Effects that are listed at most; report.json has all of them.
    exclusive = [candidate for candidate in diagnosis.ranking if not candidate.is_random][:12]
    headings = f"closes {words.IN_BINS}", words.ALONE
    random_headings = f"closes {words.IN_PIXELS}", words.PRESENT
    tables = [
        Ranking("effect", *headings, _rows(diagnosis, exclusive)),
        Ranking("random effect", *random_headings, _rows(diagnosis, words.random_ranking(diagnosis))),
    ]
    return [table for table in tables if table.rows]


def _rows(diagnosis: Diagnosis, candidates: Sequence[RankedEffect]) -> list[EffectRow]:
    marked = named_effects(diagnosis)
    return [
        EffectRow(
            candidate.id,
            words.summary(candidate.id),
            candidate.id in marked,
            candidate.gap_closed if math.isfinite(candidate.gap_closed) else 0.0,
            words.probability(candidate.confidence),
        )
        for candidate in candidates
    ]


def _strata(diagnosis: Diagnosis) -> list[tuple[str, float]]:
    return [(words.STRATA.get(name, name), value) for name, value in diagnosis.where.strata.items()]
