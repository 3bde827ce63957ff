"""The files of a blind check, sealed.json, labels.json and the results: the keys they must have."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ConfigDict, ValidationError, model_validator

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.files import UnfitFileError, read_text
from arctrack.recording.key_errors import describe
from arctrack.recording.schema import Table


class SealTable(Table):
    """A label's seal, and whether its recording is diagnosed again without what was named."""

    sha256: str
    again: bool


class SealedFile(Table):
    """sealed.json."""

    recordings: dict[str, SealTable]


class AskedTable(Table):
    """What the check is made of."""

    model_config = ConfigDict(strict=True, extra="forbid")

    draws: int
    quiet_draws: int
    tiers: str
    seed: int
    width_px: int = 640


class LabelTable(Table):
    """What a recording hides."""

    tier: str
    effects: list[str]


class SaltedTable(Table):
    """A label and the salt of its seal."""

    model_config = ConfigDict(strict=True, extra="forbid")

    salt: str
    label: LabelTable


class LabelsFile(Table):
    """labels.json."""

    asked: AskedTable
    labels: dict[str, SaltedTable]


class EffectTable(Table):
    """An effect that a diagnosis names."""

    id: str
    share: float | None
    confidence: float | None


class RankedTable(Table):
    """An effect of a diagnosis' ranking."""

    id: str
    confidence: float | None
    gap_closed: float | None


class GapTable(Table):
    """The gap between recording and model."""

    before: float | None
    floor: float | None
    closed: float | None


class WhereTable(Table):
    """Where the gap is."""

    stage: str


class NextTable(Table):
    """The experiment that is asked for."""

    experiment: str
    separates: list[str]


class ReportTable(Table):
    """What of a report the check scores."""

    verdict: str
    effects: list[EffectTable]
    ranking: list[RankedTable]
    gap: GapTable
    where: WhereTable
    not_resolvable: list[list[str]]
    next: NextTable | None
    ambiguous_with: list[list[str]]


class ResultFile(Table):
    """A file of results/; the diagnosis of a recording that had a problem has no report."""

    sealed: str
    problem: str | None
    wall_s: float
    cpu_s: float
    cosines: dict[str, float | None] | None
    report: ReportTable | None = None

    @model_validator(mode="after")
    def _has_report(self) -> ResultFile:
        if self.problem is None and self.report is None:
            raise ValueError("there is neither a report nor a problem")
        return self


def read_check_file(path: Path, kind: type[Table], cure: str = "it was there before") -> dict[str, Any]:
    """Return what a file holds, all keys that it has; ArctrackError names the first that it lacks."""
    try:
        content: dict[str, Any] = json.loads(read_text(path, LIMITS.json_bytes))
        kind.model_validate(content)
    except FileNotFoundError:
        raise in_file(path, f"is missing; {cure}") from None
    except ValidationError as error:
        raise in_file(path, f"is no file of this check: {describe(error, kind)}") from None
    except UnfitFileError as error:
        raise in_file(path, str(error), line=error.line) from None
    except (ValueError, RecursionError) as error:
        raise in_file(path, f"is no JSON: {error}") from None
    return content


class OpenedResult(NamedTuple):
    """A diagnosis of an opened check: the tier, what is hidden and what withheld, the report."""

    tier: str
    hidden: frozenset[str]
    without: frozenset[str]
    report: dict[str, Any]


def opened_results(folder: Path) -> Iterator[OpenedResult]:
    """Yield the diagnoses of a check's recordings that have a report, in the order of their files.

    Recordings that an experiment continued are left out. Seals are not verified: see `blind_check.cases`.
    """
    labels = read_check_file(folder / "labels.json", LabelsFile)["labels"]
    for path in sorted((folder / "results").glob("*.json")):
        result = read_check_file(path, ResultFile)
        if result["problem"] is None and result["experiment"] is None:
            label = labels[result["recording"]]["label"]
            hidden, without = frozenset(label["effects"]), frozenset(result["without"])
            yield OpenedResult(label["tier"], hidden, without, result["report"])
