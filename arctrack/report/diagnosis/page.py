"""report.html: a recording's diagnosis on one self-contained page, to be read in two minutes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from arctrack.output import write_whole
from arctrack.printable import quoted
from arctrack.recording import Recording
from arctrack.recording.diagnosis_files import PREDICTED_NPZ, REPORT_JSON, WHERE_NPZ
from arctrack.report.diagnosis import pictures, words
from arctrack.report.diagnosis.advice import ADVICE
from noise_model.effects import REGISTRY
from sim_to_real.diagnosis import Curve, Diagnosis, Named, Next, Verdict

TEMPLATE = "diagnosis.html.j2"

MAX_CURVES = 4
"""Covariates that are drawn; report.json has them all."""

MIN_R2_DRAWN = 0.05
"""A covariate, after the first, that explains a smaller share of the residual is not drawn."""

MAX_RANKED = 12
"""Candidates that are listed; report.json has them all."""

LABELS = {
    Verdict.NO_GAP: "no gap",
    Verdict.EFFECTS: "gap explained",
    Verdict.AMBIGUOUS: "ambiguous",
    Verdict.UNKNOWN: "unknown cause",
}

LOOK_FURTHER = (
    "See below where it lies and what it goes with, and think of what was changed last: "
    "sensor, part, setup file."
)

RECOMPUTE = f"""\
import numpy as np

held_out = np.load("{PREDICTED_NPZ}")
for mean, variance in (("before", "variance"), ("after", "variance_after")):
    r = (held_out["recorded"] - held_out[mean]) / np.sqrt(held_out[variance])
    r = r[np.isfinite(held_out[variance])]
    print(mean, np.sqrt(max(np.mean(r**2) - 1.0, 0.0)))
"""
"""Python that computes the gap anew from what was written."""


@dataclass(frozen=True)
class Row:
    """A candidate on the page: which share of the gap it closes, and how probable it is, in words."""

    id: str
    summary: str
    marked: bool
    closed: float
    confidence: str


def write_page(diagnosis: Diagnosis, recording: Recording, without: Sequence[str], path: Path) -> None:
    """Write the page to a file; `without` are the effects that were left out of the catalogue.

    Raises ArctrackError if it cannot be written.
    """
    write_whole(path, page(diagnosis, recording, without))


def page(diagnosis: Diagnosis, recording: Recording, without: Sequence[str] = ()) -> str:
    """Return the page, which needs no other file and no network."""
    environment = Environment(
        loader=PackageLoader("arctrack.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(words=words, Verdict=Verdict)
    return environment.get_template(TEMPLATE).render(**_content(diagnosis, recording, without))


def advice(diagnosis: Diagnosis) -> list[str]:
    """Return what to do now, a line each."""
    lines = []
    if diagnosis.verdict is Verdict.EFFECTS:
        lines += [f"{effect.id}: {ADVICE[effect.id]}" for effect in diagnosis.effects]
    if diagnosis.verdict is Verdict.AMBIGUOUS:
        lines += [f"If it is {name}: {ADVICE[name]}" for name in meant(diagnosis)]
    if diagnosis.verdict is Verdict.UNKNOWN:
        lines.append(LOOK_FURTHER)
    if diagnosis.next is not None:
        lines.append(_to_record(diagnosis.next, diagnosis.verdict))
    if not lines:
        lines.append("Nothing: the setup may stay as it is.")
    return lines


def _to_record(measurement: Next, verdict: Verdict) -> str:
    separates = words.listed(measurement.separates, "from")
    if measurement.resolves:
        return f"Record next: {measurement.experiment}. It tells {separates}."
    if verdict is Verdict.UNKNOWN:
        nearest = f"Nearest is {measurement.separates[0]}, which does not explain it"
        return f"{nearest}. To see that by itself, add {measurement.experiment}."
    return f"No other frames tell {separates}. Add {measurement.experiment}."


def meant(diagnosis: Diagnosis) -> list[str]:
    """Return the effects that the verdict is about: those that it names, and those that fit as well."""
    alike = (name for ids in diagnosis.ambiguous_with for name in ids)
    return list(dict.fromkeys([*(effect.id for effect in diagnosis.effects), *alike]))


def paste(effects: Sequence[Named]) -> str:
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
        "without": without,
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
        "ranking": _ranking(diagnosis),
        "strata": _strata(diagnosis),
        "smallest": {name: diagnosis.smallest[name] for name in REGISTRY if name in diagnosis.smallest},
        "paste": paste(diagnosis.effects),
        "apply": f"arctrack diagnose {quoted(recording.path)} --apply",
        "recompute": RECOMPUTE,
        "files": (REPORT_JSON, WHERE_NPZ, PREDICTED_NPZ),
    }


def drawn_curves(diagnosis: Diagnosis) -> list[Curve]:
    """Return the covariates that are worth a picture; without a gap there is nothing to explain."""
    if diagnosis.verdict is Verdict.NO_GAP:
        return []
    curves = [curve for curve in diagnosis.where.covariates if len(curve.centers)]
    return curves[:1] + [curve for curve in curves[1:MAX_CURVES] if curve.r2 >= MIN_R2_DRAWN]


def _ranking(diagnosis: Diagnosis) -> list[Row]:
    if diagnosis.verdict is Verdict.NO_GAP:
        return []
    marked = meant(diagnosis)
    return [
        Row(
            candidate.id,
            words.summary(candidate.id),
            candidate.id in marked,
            candidate.gap_closed if math.isfinite(candidate.gap_closed) else 0.0,
            words.probability(candidate.confidence),
        )
        for candidate in diagnosis.ranking[:MAX_RANKED]
    ]


def _strata(diagnosis: Diagnosis) -> list[tuple[str, float]]:
    return [(words.STRATA.get(name, name), value) for name, value in diagnosis.where.strata.items()]
