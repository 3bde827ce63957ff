"""A recording made of raw files: all of it, or nothing."""

import math
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.recording import (
    BadFrame,
    Recording,
    RecordingWriter,
    SetupFile,
    read_recording,
    read_setup_file,
)
from arctrack.recording.files import UNFINISHED_SUFFIX
from arctrack.recording.importing.colours import Bayer, Channel
from arctrack.recording.importing.columns import CsvColumns, check_all_named
from arctrack.recording.importing.conditions import (
    KNOWN_NAMES,
    NO_TABLE,
    FrameConditions,
    doubts,
    frame_rows,
    frame_times,
    read_frame_table,
)
from arctrack.recording.importing.grey_frames import GreyFrames, grey_frames
from arctrack.recording.importing.image_files import ImageSeries, check_decimals, find_images, times_in_names
from arctrack.recording.importing.pose_files import PoseFile, known_names, read_poses
from arctrack.recording.importing.profile_files import write_frames
from arctrack.recording.importing.profile_layout import ProfileLayout
from arctrack.recording.importing.units import UNSTATED, Units
from arctrack.recording.poses import can_channel
from arctrack.recording.reader import fitted
from arctrack.recording.tables import FrameRow
from arctrack.recording.time_sources import TimeSource
from noise_model.compiled.arrays import Float64
from tracker.state import Frame

OnFrame = Callable[[str, int, int], None]
"""Callback with the activity, frames done, and their total."""


@dataclass(frozen=True)
class ImportSources:
    """Raw files of an import, and how they are read.

    `sources` are images, folders of them, patterns, or one video; `setup` is a recording.toml. `poses` is a
    CSV file, or holds rotations that `translations` completes and whose notation `rotation` names. `frames`
    is a CSV file of the images' times and conditions; otherwise `rate_hz` or `times_in_names` gives the
    times. `units` are those that the user states, `columns` maps a quantity to its header. Current and
    exposure, A and s, hold for all images. `channel` is the colour that becomes grey, by default the laser's;
    `bayer` is the images' mosaic.
    Of a profiler, `sources` are files of profiles in the layout `profile`.
    """

    sources: Sequence[Path]
    setup: Path
    poses: Path
    translations: Path | None = None
    frames: Path | None = None
    rotation: str | None = None
    units: Units = UNSTATED
    columns: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    times_in_names: bool = False
    current_a: float | None = None
    exposure_s: float | None = None
    channel: Channel | None = None
    bayer: Bayer | None = None
    profile: ProfileLayout | None = None


@dataclass(frozen=True)
class ImportResult:
    """A recording that was made: `notes` say how each part was read, `warnings` what looks wrong."""

    recording: Recording
    notes: Mapping[str, str]
    warnings: tuple[str, ...]


def import_recording(
    raw: ImportSources, out: Path, on_frame: OnFrame = lambda what, done, total: None
) -> ImportResult:
    """Make a recording of raw files in a folder that must not exist yet.

    `on_frame` is called with the activity, frames done, and their total. Raises ArctrackError for a file that
    cannot be read, and where nothing states units, times or the notation of rotations; no part of a recording
    is left then.
    """
    stated = read_setup_file(raw.setup)
    profiler = stated.setup.profiler
    if (profiler is None) != (raw.profile is None):
        problem = (
            "gives images: leave --profile out" if profiler is None else "is a profiler's: give --profile"
        )
        raise in_file(raw.setup, f"[camera] {problem}")
    if profiler is None or raw.profile is None:
        return _import_images(raw, stated, out, on_frame)
    with tempfile.TemporaryDirectory() as folder:
        written = write_frames(raw.sources, raw.profile, profiler, Path(folder))
        times = TimeSource(f"the times in {raw.sources[0].name}", written.times_s)
        falls = np.flatnonzero(np.diff(written.times_s) <= 0.0)
        if len(falls) and raw.frames is None and raw.rate_hz is None:
            problem = f"the time of profile {falls[0] + 2} does not come after the one before"
            raise in_file(raw.sources[0], f"{problem}; state the times by --rate-hz or --frames")
        made = _import_images(replace(raw, sources=[Path(folder)]), stated, out, on_frame, times)
    notes = {name: text for name, text in made.notes.items() if name not in ("images", "grey")}
    return replace(made, notes={"profiles": written.note, **notes})


def _import_images(
    raw: ImportSources,
    stated: SetupFile,
    out: Path,
    on_frame: OnFrame,
    times_of_source: TimeSource | None = None,
) -> ImportResult:
    """Make a recording of images under a setup, whose source may say their times."""
    series = find_images(raw.sources)
    if times_of_source is not None:
        series = replace(series, times=times_of_source)
    names = None
    if raw.times_in_names:
        names = times_in_names(series.paths, raw.units)
        order = np.argsort(names.values, kind="stable")
        series, names = series.in_order(order.tolist()), replace(names, values=names.values[order])
    else:
        check_decimals(series)
    frame_columns = None if raw.frames is None else CsvColumns(raw.frames, raw.columns, ",".join(KNOWN_NAMES))
    table = NO_TABLE if frame_columns is None else read_frame_table(frame_columns, raw.units, series)
    times_of_table = None
    if table.times_s is not None and raw.frames is not None:
        times_of_table = TimeSource(f"the times of {raw.frames.name}", table.times_s)
    is_timed = times_of_table is not None or names is not None or raw.rate_hz is not None
    poses, pose_columns = read_poses(
        raw.poses,
        raw.translations,
        raw.rotation,
        raw.units,
        raw.columns,
        series,
        is_timed,
        can_channel=can_channel(stated.robot),
    )
    tables = [*pose_columns, *([] if frame_columns is None else [frame_columns])]
    check_all_named(raw.columns, dict.fromkeys((*known_names(raw.rotation), *KNOWN_NAMES)), tables)
    source = frame_times(series, times_of_table, names, raw.rate_hz, poses)
    times = source.values
    conditions = FrameConditions(frame_columns, raw.current_a, raw.exposure_s)
    rows, assumed = frame_rows(series, times, table, conditions, stated.setup.camera.exposure_s)
    images = grey_frames(series, stated, raw.channel, raw.bayer)
    _write(out, images, rows, _timed(poses, times), on_frame)
    recording, misfits = _read_back(out, on_frame)
    in_all = f"{', '.join(assumed)} in all" if assumed else ""
    by_table = f"as {raw.frames} states" if raw.frames is not None else ""
    notes = {
        "images": "; ".join((_span(series), *series.notes, *table.notes)),
        "grey": images.note,
        "times": f"{source.name}: {times[0]:.6g} to {times[-1]:.6g} s",
        "conditions": "; ".join(filter(None, (in_all, by_table))),
        "poses": "; ".join((_pose_note(poses), *poses.notes)),
    }
    problems = doubts(series, source, poses, images.taken_s)
    return ImportResult(
        recording, notes, (*series.warnings, *images.warnings, *poses.warnings, *problems, *misfits)
    )


def _write(
    out: Path, images: GreyFrames, rows: Sequence[FrameRow], poses: tuple[Float64, Float64], on_frame: OnFrame
) -> None:
    """Write a recording; of one that fails, or is broken off, nothing stays."""
    with RecordingWriter(out, images.setup, toml=images.toml) as writer:
        try:
            for done, (image_dn, row) in enumerate(zip(images, rows, strict=True), 1):
                writer.write_frame(
                    Frame(
                        row.index,
                        row.timestamp_s,
                        image_dn,
                        row.exposure_s,
                        row.current_a,
                        row.laser_on,
                        row.arc_on,
                    )
                )
                on_frame("importing", done, len(rows))
            for timestamp_s, T_base_tool in zip(*poses, strict=True):
                writer.write_pose(float(timestamp_s), T_base_tool)
        except BaseException:
            shutil.rmtree(out.with_name(out.name + UNFINISHED_SUFFIX), ignore_errors=True)
            raise


def _timed(poses: PoseFile, times: Float64) -> tuple[Float64, Float64]:
    """Return the poses with their times, or otherwise those of the images at the images' times.

    An image needs a pose before its own. Where the first pose is the first image's own, it is repeated one
    period earlier; nothing needs what lies between the two.
    """
    if poses.times_s is None:
        T_base_tool, poses_s = poses.T_base_tool[poses.rows], times
    else:
        T_base_tool, poses_s = poses.T_base_tool, poses.times_s
    if poses_s[0] != times[0]:
        return poses_s, T_base_tool
    # Time before a single image at which its pose is repeated.
    period_s = float(np.median(np.diff(poses_s))) if len(poses_s) > 1 else 1.0
    return np.concatenate([poses_s[:1] - period_s, poses_s]), np.concatenate([T_base_tool[:1], T_base_tool])


def _read_back(out: Path, on_frame: OnFrame) -> tuple[Recording, list[str]]:
    """Return the recording as the reader has it, and what keeps it from being tracked.

    Raises ArctrackError if it is none, or if a frame cannot be read; the folder is then taken away.
    """
    try:
        recording = read_recording(out, must_fit=False)
        for done, frame in enumerate(recording.frames(), 1):
            if isinstance(frame, BadFrame):
                raise ArctrackError(frame.message)
            on_frame("reading back", done, len(recording.rows))
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise
    try:
        return fitted(recording), []
    except ArctrackError as error:
        return recording, [str(error)]


def _span(series: ImageSeries) -> str:
    first, last = series.paths[0].name, series.paths[-1].name
    return f"{len(series)}, {first}" + (f" to {last}" if len(series) > 1 else "")


def _pose_note(poses: PoseFile) -> str:
    count = len(poses.T_base_tool)
    each = "with times" if poses.times_s is not None else "one an image, the first of them twice"
    travel_mm = poses.T_base_tool[-1, :3, 3] - poses.T_base_tool[0, :3, 3]
    return f"{count} in {poses.units}, {each}; from first to last {math.hypot(*travel_mm):.1f} mm"
