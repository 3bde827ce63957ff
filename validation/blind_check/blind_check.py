"""The blind check of the diagnosis: recordings with sealed effects made, diagnosed, and the labels opened.

A check is a folder. `make` writes `recordings/`, `labels.json` and `sealed.json`, which holds the SHA-256 of
each label with its salt; `run` sees recordings and seals alone and writes `results/`; `more` lets recordings
go on with the experiment that their diagnosis asked for, in `longer/`, and diagnoses these; `open_labels`
holds the labels against their seals and the results against the labels. Each step goes on where it was cut
short.
"""

from __future__ import annotations

import hashlib
import json
import math
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from arctrack.diagnose.diagnosis_files import plain, report
from arctrack.errors import ArctrackError, in_file
from arctrack.output import real, write_whole
from arctrack.recording import BadFrame, Recording, RecordingWriter, pose_at, read_recording
from arctrack.recording.files import UNFINISHED_SUFFIX
from arctrack.workers import processes
from sim_to_real.decision.experiments import MENU, Experiment
from tracker.state import Frame
from validation.blind_check.case import FAILED, Answer, Case
from validation.blind_check.files import LabelsFile, ResultFile, SealedFile, read_check_file
from validation.blind_check.plan import AGAIN, TIERS, RecordingPlan, plan
from validation.blind_check.score import Scores, score
from validation.second_renderer.world_stated import WIDTH_PX

if TYPE_CHECKING:
    from validation.second_renderer.scenario import MadeRecording, Scenario

SEALED, LABELS = "sealed.json", "labels.json"
RECORDINGS, LONGER, RESULTS, CACHE = "recordings", "longer", "results", "cache"

Item = TypeVar("Item")
Result = TypeVar("Result")

OnDone = Callable[[str, int, int], None]
"""Hears what is done, how many of how many are."""


@dataclass(frozen=True)
class CheckPlan:
    """What a check is made of: recordings an effect, recordings without any, tiers, and the seed of all.

    Images are `width_px` wide.
    """

    draws: int
    quiet_draws: int
    tiers: str
    seed: int
    width_px: int = WIDTH_PX

    def plan(self) -> tuple[RecordingPlan, ...]:
        """Return the recordings to make; ArctrackError for tiers or a width that there are not."""
        if WIDTH_PX % self.width_px:
            raise ArctrackError(f"--width-px {self.width_px}: must divide {WIDTH_PX}")
        try:
            return plan(self.draws, self.quiet_draws, self.tiers, self.seed, self.width_px)
        except ValueError as error:
            raise ArctrackError(f"--tiers {self.tiers}: {error}") from None


@dataclass(frozen=True)
class Run:
    """A recording to diagnose, and what is left out of the catalogue; `seal` is its label's.

    With an `experiment` it is the longer recording that goes on with that.
    """

    name: str
    seal: str
    without: tuple[str, ...] = ()
    experiment: Experiment | None = None

    @property
    def file_name(self) -> str:
        """Where its result goes."""
        return "-without-".join((self.recording.name, *self.without)) + ".json"

    @property
    def recording(self) -> Path:
        """Where the recording is, within the check's folder."""
        if self.experiment is None:
            return Path(RECORDINGS, self.name)
        return Path(LONGER, f"{self.name}-then-{self.experiment.key}")

    @property
    def in_words(self) -> str:
        """What it is."""
        then = [] if self.experiment is None else ["then", self.experiment.name]
        return " ".join((self.name, *then, *(f"without {name}" for name in self.without)))


@dataclass(frozen=True)
class CheckScores:
    """What came of checks: what each was made of, how many recordings were planned and made, the scores."""

    asked: tuple[CheckPlan, ...]
    n_planned: int
    n_made: int
    scores: Scores


def make(folder: Path, asked: CheckPlan, workers: int, on_done: OnDone) -> None:
    """Render the recordings of a check that are not there yet, and seal their labels.

    Raises ArctrackError if the folder holds another check, and if Mitsuba is missing.
    """
    planned = {f"{recording.number:04d}": recording for recording in asked.plan()}
    secret, sealed = _begun(folder, asked)
    missing = [(name, recording) for name, recording in planned.items() if name not in sealed["recordings"]]
    # Light is rendered once for each world: no two workers shall begin with the same.
    missing.sort(key=lambda pair: _turn_of_world(pair[0], planned))
    for (name, recording), label in _over(partial(_render, folder), missing, workers):
        salt = secrets.token_hex(16)
        secret["labels"][name] = {"salt": salt, "label": label}
        seal = {"sha256": seal_of(salt, label), "again": recording.tier in AGAIN and "B" in asked.tiers}
        sealed["recordings"][name] = seal
        _write(folder / LABELS, secret)
        _write(folder / SEALED, sealed)
        on_done(f"{name} made", len(sealed["recordings"]), len(planned))


def run(folder: Path, workers: int, on_done: OnDone) -> None:
    """Diagnose what is sealed and not diagnosed yet; then again, without the effect that was named alone.

    The labels stay closed. A recording whose diagnosis fails gets a result that says why.
    """
    sealed = read_check_file(
        folder / SEALED, SealedFile, "run `python -m validation.blind_check make` first"
    )["recordings"]
    first = [Run(name, seal["sha256"]) for name, seal in sealed.items()]
    _diagnose_all(folder, first, workers, on_done)
    again = []
    for run in first:
        if sealed[run.name]["again"]:
            alone = answer_of(read_check_file(folder / RESULTS / run.file_name, ResultFile)).alone
            again += [] if alone is None else [Run(run.name, run.seal, (alone,))]
    _diagnose_all(folder, again, workers, on_done)


def more(folder: Path, workers: int, on_done: OnDone) -> None:
    """Let recordings go on with the experiment that their first diagnosis asked for, and diagnose these.

    Those that hide nothing are left out. What cannot be rendered or diagnosed gets a result that says why.
    Raises ArctrackError as `open_labels`, and if Mitsuba is missing.
    """
    sealed, secret = _verified(folder)
    planned = {f"{run.number:04d}": run for run in CheckPlan(**secret["asked"]).plan()}
    runs = []
    for name, seal in sorted(sealed.items()):
        if secret["labels"][name]["label"]["effects"]:
            first = Run(name, seal["sha256"])
            asked_for = _continued(first, answer_of(_result(folder, first)))
            runs += [] if asked_for is None else [asked_for]
    missing = _missing(folder, runs)
    sources = [(run, planned[run.name], secret["labels"][run.name]["salt"]) for run in missing]
    n_done = len(runs) - len(missing)
    for (run, _, _), result in _over(partial(_taken, folder), sources, workers):
        n_done += 1
        _keep(folder, run, result, n_done, len(runs), on_done)


def open_labels(*folders: Path) -> CheckScores:
    """Verify the labels of one check, or of several, and score all results together; writes nothing.

    Raises ArctrackError if a label is not the one that was sealed, or a result not that of this seal, and if
    two checks are of one seed: they share recordings.
    """
    asked: list[CheckPlan] = []
    of_seed: dict[int, Path] = {}
    every: list[Case] = []
    for folder in folders:
        sealed, secret = _verified(folder)
        options = CheckPlan(**secret["asked"])
        if options.seed in of_seed:
            other = of_seed[options.seed]
            raise in_file(folder, f"is of the seed {options.seed} as is {other}: they share recordings")
        of_seed[options.seed] = folder
        asked.append(options)
        mark = f"{real(folder).name}/" if len(folders) > 1 else ""
        every += [replace(case, name=mark + case.name) for case in _cases(folder, sealed, secret)]
    n_planned = sum(len(options.plan()) for options in asked)
    tiers = "".join(tier for tier in TIERS if any(tier in options.tiers for options in asked))
    return CheckScores(tuple(asked), n_planned, len(every), score(every, tiers))


def cases(folder: Path) -> list[Case]:
    """Return the recordings of a check, what they hide and what was answered; writes nothing.

    Raises ArctrackError if a label is not the one that was sealed, or a result not that of this seal.
    """
    return _cases(folder, *_verified(folder))


def _cases(folder: Path, sealed: Mapping[str, Any], secret: Mapping[str, Any]) -> list[Case]:
    return [
        _case(folder, Run(name, seal["sha256"]), seal["again"], secret["labels"][name]["label"])
        for name, seal in sorted(sealed.items())
    ]


def scores_json(opened: CheckScores) -> dict[str, Any]:
    """Return what scores.json holds; what is not known is null."""
    scores = opened.scores
    content: dict[str, Any] = plain(asdict(opened))
    rates = [
        (kept["rate"], known.rate)
        for kept, known in zip(content["scores"]["rates"], scores.rates, strict=True)
    ]
    for kept, known in zip(content["scores"]["calibration"], scores.calibration, strict=True):
        rates += [(kept["in_catalogue"], known.in_catalogue), (kept["withheld"], known.withheld)]
    for kept, rate in rates:
        kept |= {"share": plain(rate.share), "bounds": plain(rate.bounds)}
    return content


def answer_of(result: Mapping[str, Any]) -> Answer:
    """Return the answer that a result's file holds."""
    times = {name: result[name] for name in ("wall_s", "cpu_s")}
    if result["problem"] is not None:
        return Answer(FAILED, problem=result["problem"], **times)
    said = result["report"]
    asked_for = said["next"] or {"experiment": "", "separates": ()}
    named = sorted(said["effects"], key=lambda effect: -(effect["share"] or 0.0))
    ranking, gap = said["ranking"], said["gap"]
    return Answer(
        verdict=said["verdict"],
        named=tuple(effect["id"] for effect in named),
        ranked=tuple(entry["id"] for entry in ranking),
        confidence=next((_known(entry["confidence"]) for entry in (*named, *ranking)), math.nan),
        closes={entry["id"]: _known(entry["gap_closed"]) for entry in ranking},
        stage=said["where"]["stage"],
        gap_before=_known(gap["before"]),
        gap_floor=_known(gap["floor"]),
        gap_closed=_known(gap["closed"]),
        unresolvable=frozenset(frozenset(pair) for pair in said["not_resolvable"]),
        experiment=asked_for["experiment"],
        separates=tuple(asked_for["separates"]),
        alike=tuple(name for ids in said["ambiguous_with"] for name in ids),
        **times,
    )


def _begun(folder: Path, asked: CheckPlan) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return labels and seals as far as they are there."""
    if not (folder / LABELS).exists():
        (folder / RECORDINGS).mkdir(parents=True, exist_ok=True)
        return {"asked": asdict(asked), "labels": {}}, {"recordings": {}}
    secret = read_check_file(folder / LABELS, LabelsFile)
    if secret["asked"] != asdict(asked):
        before = ", ".join(f"{key} = {value}" for key, value in secret["asked"].items())
        raise in_file(folder, f"holds a check of {before}; repeat these, or choose another --out")
    sealed = (
        read_check_file(folder / SEALED, SealedFile) if (folder / SEALED).exists() else {"recordings": {}}
    )
    return secret, sealed


def _verified(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return seals by name, and what labels.json holds. Raises ArctrackError for a label that was altered."""
    sealed = read_check_file(
        folder / SEALED, SealedFile, "run `python -m validation.blind_check make` first"
    )["recordings"]
    secret = read_check_file(folder / LABELS, LabelsFile, "without the labels there is nothing to open")
    for name in sorted(sealed.keys() | secret["labels"].keys()):
        kept = secret["labels"].get(name)
        # A label without a seal is that of a recording whose making was cut short.
        if name in sealed and (kept is None or seal_of(**kept) != sealed[name]["sha256"]):
            raise in_file(folder / LABELS, f"the label of {name} is not the one that was sealed")
    return sealed, secret


def _turn_of_world(name: str, planned: Mapping[str, RecordingPlan]) -> int:
    """Return how many recordings with the same world come before one."""
    world = planned[name].world_seed
    return sum(other < name and recording.world_seed == world for other, recording in planned.items())


def _render(folder: Path, named: tuple[str, RecordingPlan]) -> dict[str, Any]:
    """Make a recording, if it is not there, and return its label. The truth is not written beside it."""
    from validation.second_renderer.scenario import make

    name, planned = named
    with _renderer():
        scenario = _drawn(planned)
        path = folder / RECORDINGS / name
        if not path.exists():
            recorded = make(scenario, folder / CACHE)
            _record(path, recorded, recorded.frames)
    return scenario.labels


def _render_longer(folder: Path, run: Run, planned: RecordingPlan, salt: str) -> None:
    """Make a recording that goes on with an experiment, if it is not there: the frames there are, and more.

    Raises ValueError if the label that is drawn is not the one that was sealed.
    """
    from validation.second_renderer.scenario import followed_by, make

    assert run.experiment is not None, "the run itself is there"
    path = folder / run.recording
    if path.exists():
        return
    scenario = _drawn(planned)
    if seal_of(salt, scenario.labels) != run.seal:
        raise ValueError("what is drawn now is not what was sealed: the renderer has changed since")
    longer = make(followed_by(scenario, run.experiment), folder / CACHE, scenario.n_run)
    (folder / LONGER).mkdir(exist_ok=True)
    _record(path, longer, (*_frames(read_recording(folder / RECORDINGS / run.name)), *longer.frames))


def _drawn(planned: RecordingPlan) -> Scenario:
    from validation.second_renderer.scenario import draw

    return draw(
        planned.seed,
        planned.tier,
        world_seed=planned.world_seed,
        joint=planned.joint,
        effects=planned.effects,
        form=planned.form,
        is_dry=planned.is_dry,
        width_px=planned.width_px,
    )


@contextmanager
def _renderer() -> Iterator[None]:
    """Say what is to be installed where the renderer cannot start."""
    try:
        yield
    except ImportError as error:
        raise ArctrackError(
            f"the check's renderer needs pip install 'arctrack[reference]': {error}"
        ) from None


def _record(path: Path, recorded: MadeRecording, frames: Iterable[Frame]) -> None:
    """Write a recording with its poses, and no truth."""
    shutil.rmtree(path.with_name(path.name + UNFINISHED_SUFFIX), ignore_errors=True)
    with RecordingWriter(path, recorded.setup) as writer:
        for timestamp_s, T_base_tool in recorded.poses:
            writer.write_pose(timestamp_s, T_base_tool)
        for frame in frames:
            writer.write_frame(frame)


def _frames(recording: Recording) -> list[Frame]:
    return [frame for frame in recording.frames() if not isinstance(frame, BadFrame)]


def _diagnose_all(folder: Path, runs: Sequence[Run], workers: int, on_done: OnDone) -> None:
    missing = _missing(folder, runs)
    n_done = len(runs) - len(missing)
    for run, result in _over(partial(_diagnosed, folder), missing, workers):
        n_done += 1
        _keep(folder, run, result, n_done, len(runs), on_done)


def _missing(folder: Path, runs: Sequence[Run]) -> list[Run]:
    (folder / RESULTS).mkdir(exist_ok=True)
    return [run for run in runs if not (folder / RESULTS / run.file_name).exists()]


def _keep(
    folder: Path, run: Run, result: Mapping[str, Any], n_done: int, total: int, on_done: OnDone
) -> None:
    _write(folder / RESULTS / run.file_name, result)
    on_done(f"{run.in_words}: {_in_words(answer_of(result))}", n_done, total)


def _in_words(answer: Answer) -> str:
    if answer.problem:
        return f"{answer.verdict}: {answer.problem}"
    return " ".join((answer.verdict, *answer.named, f"({answer.wall_s:.0f} s)"))


def _taken(folder: Path, source: tuple[Run, RecordingPlan, str]) -> dict[str, Any]:
    """Make a recording that goes on with an experiment, and return its result; no label is diagnosed with."""
    run, planned, salt = source
    started = time.perf_counter(), time.process_time()
    with _renderer():
        try:
            _render_longer(folder, run, planned, salt)
        except ImportError:
            raise
        except Exception as error:
            return _blank(run) | _problem(error) | _since(*started)
    return _diagnosed(folder, run)


def _diagnosed(folder: Path, run: Run) -> dict[str, Any]:
    """Return a run's result: the report, the baseline, the times, and the problem if there is one."""
    from sim_to_real.diagnose import diagnose
    from validation.blind_check.cosine import cosines

    result = _blank(run)
    started = time.perf_counter(), time.process_time()
    try:
        recording = read_recording(folder / run.recording)
        frames = _frames(recording)
        pose_of = partial(pose_at, recording.pose_buffer())
        result["report"] = report(diagnose(recording.setup, frames, pose_of, without=run.without))
    except Exception as error:
        # One recording that fails is a wrong answer, not the end of the check.
        return result | _problem(error) | _since(*started)
    result |= _since(*started)
    if not run.without and run.experiment is None:
        # The baseline that fails is no answer of the baseline; the diagnosis stands.
        with suppress(Exception):
            result["cosines"] = plain(cosines(recording.setup, frames, pose_of))
    return result


def _blank(run: Run) -> dict[str, Any]:
    """Return what a result says of its run."""
    return {
        "recording": run.name,
        "sealed": run.seal,
        "without": list(run.without),
        "experiment": None if run.experiment is None else run.experiment.name,
        "problem": None,
        "cosines": None,
    }


def _problem(error: Exception) -> dict[str, str]:
    return {"problem": f"{type(error).__name__}: {error}"}


def _since(wall_s: float, cpu_s: float) -> dict[str, float]:
    return {"wall_s": time.perf_counter() - wall_s, "cpu_s": time.process_time() - cpu_s}


def _case(folder: Path, run: Run, is_again: bool, label: Mapping[str, Any]) -> Case:
    result = _result(folder, run)
    answer = answer_of(result)
    again = None
    if is_again and answer.alone is not None:
        again = answer_of(_result(folder, Run(run.name, run.seal, (answer.alone,))))
    longer, asked_for = None, _continued(run, answer)
    if asked_for is not None and (folder / RESULTS / asked_for.file_name).exists():
        longer = answer_of(_result(folder, asked_for))
    likeness = [(name, value) for name, value in (result["cosines"] or {}).items() if value is not None]
    likeness.sort(key=lambda pair: -abs(pair[1]))
    return Case(run.name, label["tier"], tuple(label["effects"]), answer, tuple(likeness), again, longer)


def _continued(run: Run, answer: Answer) -> Run | None:
    """Return the run with the experiment that an answer asks for, None if that is none of the menu."""
    experiment = next((known for known in MENU if known.name == answer.experiment), None)
    return None if experiment is None else replace(run, experiment=experiment)


def _result(folder: Path, run: Run) -> dict[str, Any]:
    """Return a run's result; one that is missing is a failure."""
    path = folder / RESULTS / run.file_name
    if not path.exists():
        return {"problem": "not diagnosed", "wall_s": math.nan, "cpu_s": math.nan, "cosines": None}
    result = read_check_file(path, ResultFile)
    if result["sealed"] != run.seal:
        raise in_file(path, "is the result of a recording with another seal; remove it and run again")
    return result


def _over(
    work: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Iterator[tuple[Item, Result]]:
    """Yield items with what work makes of them, as they come."""
    if workers == 1:
        for item in items:
            yield item, work(item)
        return
    with processes(workers) as executor:
        futures = {executor.submit(work, item): item for item in items}
        for future in as_completed(futures):
            yield futures[future], future.result()


def seal_of(salt: str, label: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a salt and a label."""
    return hashlib.sha256((salt + json.dumps(label, sort_keys=True)).encode()).hexdigest()


def _write(path: Path, content: Mapping[str, Any]) -> None:
    write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _known(value: float | None) -> float:
    return math.nan if value is None else value
