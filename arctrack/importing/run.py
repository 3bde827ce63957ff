"""A recording made of raw files: all of it, or nothing."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.importing.colours import Bayer, Channel
from arctrack.importing.columns import Columns, check_all_named
from arctrack.importing.conditions import (
    KNOWN_NAMES,
    NO_TABLE,
    Conditions,
    doubts,
    frame_rows,
    frame_times,
    read_frame_table,
    times_in_names,
)
from arctrack.importing.grey import camera_of_sites, channel_of_laser, grey, sites
from arctrack.importing.image_decoder import EncodedImage
from arctrack.importing.image_files import ImageSeries, find_images
from arctrack.importing.pose_files import PoseFile, known_names, read_poses
from arctrack.importing.units import UNSTATED, Units
from arctrack.recording import Recording, RecordingWriter, SetupFile, read_recording, read_setup_file
from arctrack.recording.reader import UNFINISHED_SUFFIX, fitted
from arctrack.recording.setup_file import parse_setup, setup_text, with_camera_keys
from arctrack.recording.tables import FrameRow
from noise_model.arrays import Float64, Integers
from noise_model.effects import acting
from noise_model.setup import Setup
from tracker.state import Frame, frame_misfit

LOSSY = "JPEG has changed the noise that sigmas are read from; have the camera write PNG, BMP or TIFF"

LONE_PERIOD_S = 1.0
"""How long before a single image its pose is repeated."""


@dataclass(frozen=True)
class RawFiles:
    """What an import is made of, and how it reads.

    Attributes
    ----------
    sources : sequence of Path
        Images, folders of them, patterns.
    setup : Path
        A recording.toml.
    poses : Path
        The robot's poses: a CSV file, or rotations.
    translations : Path, optional
        The places that belong to rotations.
    frames : Path, optional
        A CSV file of the images' times and conditions.
    rotation : str, optional
        How rotations are written, by name.
    units : Units
        Those that the user states.
    columns : mapping of str to str
        What a column is, and its header.
    rate_hz : float, optional
        Images a second.
    times_in_names : bool
        Whether names end with times.
    current_a, exposure_s : float, optional
        The welding current and the exposure of all images, A and s.
    channel : Channel, optional
        The colour that becomes grey; by default the laser's.
    bayer : Bayer, optional
        The mosaic that the images are of.
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


@dataclass(frozen=True)
class Imported:
    """A recording that was made: `notes` say how each part was read, `warnings` what looks wrong."""

    recording: Recording
    notes: Mapping[str, str]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Light:
    """How pixels become grey levels: sites of a mosaic, or a colour."""

    channel: Channel
    bayer: Bayer | None
    size: tuple[int, int]
    first: EncodedImage

    def __call__(self, pixels: Integers, path: Path) -> Integers:
        if self.bayer is None:
            return grey(pixels, self.channel)
        if pixels.ndim > 2:
            raise in_file(path, "has colours: a mosaic is grey; leave --bayer out")
        return sites(pixels, self.bayer, self.channel)


def import_recording(
    raw: RawFiles, out: Path, on_frame: Callable[[int, int], None] = lambda done, total: None
) -> Imported:
    """Make a recording of raw files.

    Parameters
    ----------
    raw : RawFiles
        What to read, and how.
    out : Path
        The recording's folder, which must not exist yet.
    on_frame : callable
        Is told how many frames are written, and of how many.

    Returns
    -------
    Imported
        The recording as the reader has it, and what to tell of it.

    Raises
    ------
    ArctrackError
        For a file that cannot be read, and for what nothing states: units, times, the way a rotation is
        written. It names the file and the cure. No recording is left then, nor a part of one.
    """
    stated = read_setup_file(raw.setup)
    series = find_images(raw.sources)
    names_s = None
    if raw.times_in_names:
        names_s = times_in_names(series, raw.units)
        order = np.argsort(names_s, kind="stable")
        series, names_s = series.in_order(order.tolist()), names_s[order]
    poses, pose_columns = read_poses(
        raw.poses, raw.translations, raw.rotation, raw.units, raw.columns, series
    )
    frame_columns = None if raw.frames is None else Columns(raw.frames, raw.columns, ",".join(KNOWN_NAMES))
    tables = [*pose_columns, *([] if frame_columns is None else [frame_columns])]
    check_all_named(raw.columns, dict.fromkeys((*known_names(raw.rotation), *KNOWN_NAMES)), tables)
    table = NO_TABLE if frame_columns is None else read_frame_table(frame_columns, raw.units, series)
    times_of_table = None if table.times_s is None or raw.frames is None else (raw.frames, table.times_s)
    times, source = frame_times(series, times_of_table, names_s, raw.rate_hz, poses)
    conditions = Conditions(frame_columns, raw.current_a, raw.exposure_s)
    rows, assumed = frame_rows(series, times, table, conditions, stated.setup.camera.exposure_s)
    light, toml, setup = _light(raw, stated, series)
    _write(out, setup, toml, _frames(series, rows, light, setup), poses, times, on_frame)
    recording, misfits = _read_back(out)
    notes = {
        "images": "; ".join((_span(series), *series.notes, *table.notes)),
        "grey": _grey_note(light, stated.setup, setup),
        "times": f"{source}: {times[0]:.6g} to {times[-1]:.6g} s",
        "frames.csv": "; ".join((*assumed, *([f"the rest of {raw.frames}"] if raw.frames else []))),
        "poses": "; ".join((_pose_note(poses), *poses.notes)),
    }
    lossy = [f"{series.paths[0]}: {LOSSY}"] if light.first.is_lossy else []
    return Imported(recording, notes, (*lossy, *poses.warnings, *doubts(times, source), *misfits))


def _light(raw: RawFiles, stated: SetupFile, series: ImageSeries) -> tuple[_Light, str, Setup]:
    """Return how pixels become grey levels, and the setup of these with its text.

    A setup of the whole mosaic's size becomes that of its sites; one of the sites' size stays.
    """
    setup, camera = stated.setup, stated.setup.camera
    channel = raw.channel or channel_of_laser(setup)
    text = setup_text(stated.path)
    first = EncodedImage(series.paths[0])
    if raw.bayer is None:
        return _Light(channel, None, (camera.width, camera.height), first), text, setup
    if channel is Channel.LUMINANCE:
        raise ArctrackError(
            "--channel luminance: a mosaic's sites have one colour each; give red, green or blue"
        )
    width, height = first.size
    if (camera.width, camera.height) in _sizes_of_sites(width, height):
        return _Light(channel, raw.bayer, first.size, first), text, setup
    _check_no_effect_in_px(setup, stated.path)
    text = with_camera_keys(stated.path, camera_of_sites(setup, raw.bayer, channel))
    return (
        _Light(channel, raw.bayer, (camera.width, camera.height), first),
        text,
        parse_setup(text, stated.path).setup,
    )


def _sizes_of_sites(width: int, height: int) -> list[tuple[int, int]]:
    return [((width + a) // 2, (height + b) // 2) for a in (0, 1) for b in (0, 1)]


def _check_no_effect_in_px(setup: Setup, path: Path) -> None:
    for effect, _ in acting(setup):
        for parameter in effect.parameters:
            if parameter.unit == "px":
                raise in_file(
                    path,
                    f"[effects.{effect.id}] {parameter.name} is in px of the whole mosaic; state effects and "
                    "[camera] as those of its sites, half the width and height",
                )


def _frames(series: ImageSeries, rows: Sequence[FrameRow], light: _Light, setup: Setup) -> Iterator[Frame]:
    for path, row in zip(series.paths, rows, strict=True):
        image_dn = _image(path, light, setup)
        yield Frame(
            index=row.index,
            timestamp_s=row.timestamp_s,
            image_dn=image_dn,
            exposure_s=row.exposure_s,
            current_a=row.current_a,
            laser_on=row.laser_on,
            arc_on=row.arc_on,
        )


def _image(path: Path, light: _Light, setup: Setup) -> Integers:
    encoded = EncodedImage(path)
    if encoded.size != light.size:
        width, height = light.size
        turned = "; it is turned: swap rows and columns" if encoded.size == (height, width) else ""
        what = "the first mosaic is" if light.bayer is not None else "[camera] width and height are"
        raise in_file(path, f"is {encoded.size[0]} x {encoded.size[1]} px, {what} {width} x {height}{turned}")
    image_dn = light(encoded.pixels(), path)
    misfit = frame_misfit(image_dn.shape, image_dn.dtype, setup)
    if misfit is not None:
        raise in_file(path, misfit)
    brightest = int(image_dn.max())
    if brightest > setup.sensor.max_dn:
        spare = 16 - setup.sensor.bits
        shifted = not (image_dn & ((1 << spare) - 1)).any()
        cure = (
            f"; its levels are multiples of {1 << spare}: state bits = 16, with gain and black level of these"
        )
        raise in_file(
            path,
            f"holds {brightest} DN, [sensor] bits = {setup.sensor.bits} ends at {setup.sensor.max_dn}"
            f"{cure if shifted else ''}",
        )
    return image_dn


def _write(
    out: Path,
    setup: Setup,
    toml: str,
    frames: Iterator[Frame],
    poses: PoseFile,
    times: Float64,
    on_frame: Callable[[int, int], None],
) -> None:
    """Write a recording; of one that fails, or is broken off, nothing stays."""
    with RecordingWriter(out, setup, toml=toml) as writer:
        try:
            for done, frame in enumerate(frames, 1):
                writer.write_frame(frame)
                on_frame(done, len(times))
            for timestamp_s, T_base_tool in zip(*_timed(poses, times), strict=True):
                writer.write_pose(float(timestamp_s), T_base_tool)
        except BaseException:
            shutil.rmtree(out.with_name(out.name + UNFINISHED_SUFFIX), ignore_errors=True)
            raise


def _timed(poses: PoseFile, times: Float64) -> tuple[Float64, Float64]:
    """Return the poses with their times, or else those of the images at the images' times.

    The first image needs a pose before its own: its own once more, one period earlier. Nothing asks for what
    lies between the two.
    """
    if poses.times_s is not None:
        return poses.times_s, poses.T_base_tool
    T_base_tool = poses.T_base_tool[poses.rows]
    period_s = float(np.median(np.diff(times))) if len(times) > 1 else LONE_PERIOD_S
    return np.concatenate([times[:1] - period_s, times]), np.concatenate([T_base_tool[:1], T_base_tool])


def _read_back(out: Path) -> tuple[Recording, list[str]]:
    """Return the recording as the reader has it, and what keeps it from being tracked.

    Raises ArctrackError if it is none; the folder is then taken away.
    """
    try:
        recording = read_recording(out, must_fit=False)
        recording.readable_frames()
    except ArctrackError:
        shutil.rmtree(out, ignore_errors=True)
        raise
    try:
        return fitted(recording), []
    except ArctrackError as error:
        return recording, [*recording.warnings, str(error)]


def _span(series: ImageSeries) -> str:
    first, last = series.paths[0].name, series.paths[-1].name
    return f"{len(series)}, {first}" + (f" to {last}" if len(series) > 1 else "")


def _grey_note(light: _Light, stated: Setup, setup: Setup) -> str:
    why = f"the laser has {stated.laser.wavelength_nm:g} nm"
    if light.bayer is None:
        return f"{light.channel.value} of the colours ({why})" if light.first.has_colours else "as it is"
    note = (
        f"{light.channel.value} sites of {light.bayer.value}, {setup.camera.width} x {setup.camera.height} px"
    )
    if setup is stated:
        return f"{note}, the size of [camera]"
    return (
        f"{note}; [camera] of the mosaic made theirs: fx {setup.camera.fx:.6g}, cx {setup.camera.cx:.6g} px"
    )


def _pose_note(poses: PoseFile) -> str:
    count = len(poses.T_base_tool)
    each = "with times" if poses.times_s is not None else "one an image, the first of them twice"
    travel_mm = poses.T_base_tool[-1, :3, 3] - poses.T_base_tool[0, :3, 3]
    return f"{count} in {poses.units}, {each}; from first to last {math.hypot(*travel_mm):.1f} mm"
