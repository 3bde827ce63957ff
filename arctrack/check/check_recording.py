"""Does a recording fit its setup? Some frames are looked at; nothing is tracked from frame to frame."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from arctrack.check.check_sample import CheckCase, case_of, chosen_rows, laser_off_rows
from arctrack.check.explanations import MIN_PROBABILITY, WeighedCause, explanations
from arctrack.check.findings import SetupFinding, findings, timing_findings
from arctrack.check.hint import Hint, hint_of
from arctrack.check.look import CheckedFrame, looks_at
from arctrack.check.seam_place import seam_place
from arctrack.check.sensor_seen import SensorReading, sensor_seen
from arctrack.check.timing import timing_of
from arctrack.check.units import likely_unit
from arctrack.check.verdict import RunVerdict, is_few, verdict_of
from arctrack.compiling import compiled_by_two
from arctrack.errors import ArctrackError, in_file
from arctrack.offset_count import OffsetCount
from arctrack.recording import BadFrame, Recording
from arctrack.recording.reader import fitted
from arctrack.replay.replay_loop import Trial, rows_to_try, try_out
from tracker.geometry import SensorGeometry
from tracker.seam.correction import UNSTATED
from tracker.state import Frame, Track
from tracker.warm_up import warm_up

MIN_ON_JOINT = 0.85
"""Share of the bright lines' points that lie on the joint where the setup holds: glints and tacks do not."""

MAX_DARK_FRAMES = 2
"""Number of frames without laser and arc that black level and noise are measured in."""


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Result of a check.

    `refusal` is why a replay refuses the recording, None if it does not; `bad_frames` cannot be used. `hint`
    is the likeliest mistake, which may exist although most frames are valid, each by itself. `case` has the
    bright lines of the frames examined, None where no image can be read.
    """

    recording: Recording
    refusal: ArctrackError | None
    verdict: RunVerdict
    hint: Hint | None
    findings: tuple[SetupFinding, ...]
    looks: tuple[CheckedFrame, ...]
    bad_frames: tuple[BadFrame, ...]
    case: CheckCase | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user, one line each."""
        return tuple(finding.warning for finding in self.findings if finding.warning is not None)


def check_recording(recording: Recording, on_frame: Callable[[int], None] | None = None) -> CheckResult:
    """Check a recording that was read without `must_fit`.

    `on_frame` is called with the number of frames examined.
    """
    refusal: ArctrackError | None = None
    geometry: SensorGeometry | None = None
    try:
        fitted(recording)
        geometry = SensorGeometry.of(recording.setup)
    except ArctrackError as error:
        refusal = error
    except ValueError as error:
        refusal = in_file(recording.setup_path, str(error))
    positions = chosen_rows(recording)
    # Of a profiler, what images show is not asked.
    is_image = recording.setup.profiler is None
    case = case_of(recording) if is_image else None
    frames, bad_frames = parted(recording.frames(positions))
    timing = timing_of(recording)
    looks, unlit = [], []
    if geometry is not None:
        with compiled_by_two(geometry.setup):
            warm_up(geometry, UNSTATED)
    if geometry is not None and is_image:
        looks = looks_at(recording, geometry, frames, on_frame)
        unlit = looks_at(recording, geometry, _as_if_lit(recording))
    tried = rows_to_try(recording)
    trial = _untracked(recording, tried) if refusal is not None else try_out(recording, tried)
    lit = [t for n, t in zip(tried, trial.tracks, strict=True) if recording.rows[n].laser_on]
    is_tracked = not is_few(sum(track.valid for track in lit), len(lit), trial.offsets)
    seam = seam_place(recording, lit)
    is_sound = is_tracked and not seam.is_beyond_search and (case is None or _lies_as_stated(case))
    ranked = [] if case is None or is_sound else explanations(case)
    hint = hint_of(ranked)
    if hint is None and not is_tracked:
        hint = likely_unit(recording)
    all_findings = list(timing_findings(timing))
    if ranked:
        all_findings.append(_causes_finding(ranked))
    if case is not None and case.fits_camera:
        all_findings.append(_lines_finding(case, hint if is_tracked else None))
    if geometry is not None and is_image:
        sensor = sensor_of(recording, looks)
        all_findings += findings(recording.setup, geometry, looks, unlit, sensor, timing.exposures_fit)
    if hint is not None:
        # Where something decided is wrong, seam and stripe lie elsewhere for that reason.
        all_findings = [replace(f, warning=None) if f.name in ("seam", "course") else f for f in all_findings]
    verdict = verdict_of(len(tried), lit, trial.offsets, trial.reasons, lambda: hint)
    return CheckResult(
        recording=recording,
        refusal=refusal,
        verdict=verdict,
        hint=hint,
        findings=tuple(all_findings),
        looks=tuple(looks),
        bad_frames=tuple(bad_frames),
        case=case,
    )


def _lies_as_stated(case: CheckCase) -> bool:
    """Return True if the bright lines lie on the stated joint."""
    return case.fits_camera and case.section_match.share >= MIN_ON_JOINT


def _lines_finding(case: CheckCase, hint: Hint | None) -> SetupFinding:
    """Find how well the bright lines lie on the stated joint, and what most likely is wrong if not."""
    text = f"{100.0 * case.section_match.share:.0f} % of the bright lines' points lie on the stated joint"
    if hint is None:
        return SetupFinding("lines", text)
    if hint.case is None:
        return SetupFinding("lines", text, f"{text}; most likely {hint}")
    return SetupFinding("lines", text, f"{text}, {100.0 * hint.case.section_match.share:.0f} % if {hint}")


def _causes_finding(ranked: Sequence[WeighedCause]) -> SetupFinding:
    """Find how probable the causes are, the likeliest first."""
    listed = (each for each in ranked if each.probability >= MIN_PROBABILITY)
    named = [f"{100.0 * each.probability:.0f} % {each.name}" for each in listed]
    return SetupFinding("causes", ", ".join(named))


def _untracked(recording: Recording, positions: Sequence[int]) -> Trial:
    """Return the trial of a recording that a replay refuses: no offset goes out."""
    rows = [recording.rows[n] for n in positions]
    tracks = tuple(Track(row.index, row.timestamp_s, 0) for row in rows)
    return Trial(tracks, OffsetCount(0, sum(row.arc_on for row in rows)), {})


def parted(frames: Iterable[Frame | BadFrame]) -> tuple[list[Frame], list[BadFrame]]:
    """Return the frames that can be used and those that cannot."""
    usable: list[Frame] = []
    bad: list[BadFrame] = []
    for frame in frames:
        if isinstance(frame, BadFrame):
            bad.append(frame)
        else:
            usable.append(frame)
    return usable, bad


def _as_if_lit(recording: Recording) -> list[Frame]:
    """Return frames that frames.csv says the laser is off in, as if it were on."""
    frames, _ = parted(recording.frames(laser_off_rows(recording)))
    return [replace(frame, laser_on=True) for frame in frames]


def sensor_of(recording: Recording, looks: Sequence[CheckedFrame]) -> SensorReading:
    """Look at frames without laser and arc, or else at those with the laser alone."""
    dark = [n for n, row in enumerate(recording.rows) if not (row.laser_on or row.arc_on)]
    frames, _ = parted(recording.frames(dark[:MAX_DARK_FRAMES]))
    laser_alone = [look for look in looks if not look.frame.arc_on]
    return sensor_seen(
        [frame.image_dn for frame in frames],
        [look.frame.image_dn for look in laser_alone],
        [look.line for look in laser_alone],
    )
