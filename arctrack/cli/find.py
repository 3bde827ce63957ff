"""`arctrack find`: where the joint is, before welding."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from arctrack.cli.inputs import check_can_be_replaced, look_at_cell, look_at_recordings
from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from arctrack.control.job import PartLimits
    from arctrack.recording import Recording
    from arctrack.recording.found_file import FoundPoint
    from tracker.find import FoundJoint, Kind


def find(
    recordings: Annotated[
        list[Path],
        typer.Argument(help="Folders that hold the frames of one point each; its name is the folder's."),
    ],
    kind: Annotated[
        str,
        typer.Option(
            help="seam; start or end of it, whose frames show the joint and the place without it; corner, at "
            "which the seams of two recordings meet."
        ),
    ] = "seam",
    out: Annotated[
        Path | None, typer.Option(help="File of found points; those of other names in it stay.")
    ] = None,
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml to use instead of each recording's own.")
    ] = None,
    cell: Annotated[
        Path | None, typer.Option(help="A cell.toml, for its job's joint and the limits of the part.")
    ] = None,
    job: Annotated[int | None, typer.Option(help="The job of the cell file, by its number.")] = None,
) -> None:
    """Find the joint before welding: its place, direction and attitude in base, or why there is none.

    The frames of a point are taken with the laser on and no arc, at one place or a few along the seam. One
    place does not tell the seam's direction; two, some 20 mm apart, do. Where the robot has searched off its
    path the frames that show the joint count. A part that is not as the job requires is refused by name.
    The exit code is 0 if all was found, 1 if some was, 3 if nothing was.
    """
    if cell is not None:
        look_at_cell(cell)
    look_at_recordings(recordings, setup)
    from arctrack.cli import console
    from arctrack.cli.exit_codes import NOTHING_TRACKED, WARNED
    from arctrack.control.cell_file import read_cell_file
    from arctrack.control.job import PartLimits
    from arctrack.control.recorded_job import with_job
    from arctrack.recording import read_recording
    from arctrack.recording.found_file import add_found
    from tracker.find import Kind

    if kind not in get_args(Kind):
        raise ArctrackError(f"--kind {kind}: must be seam, start, end or corner")
    if kind == "corner" and len(recordings) != 2:
        raise ArctrackError("--kind corner: two recordings, one of each seam, make a corner")
    if out is not None:
        check_can_be_replaced(out)
    stated = None if cell is None else read_cell_file(cell)
    limits = PartLimits() if stated is None else stated.jobs[stated.job_numbered(job)].part
    read = [with_job(read_recording(folder, setup), stated, job) for folder in recordings]
    points = _find(read, cast("Kind", kind), limits)
    console.say(*(line for point in points for line in _lines(point)))
    if out is not None:
        console.say(add_found(out, points))
    refused = [point for point in points if point.refusal]
    if refused:
        raise typer.Exit(NOTHING_TRACKED if len(refused) == len(points) else WARNED)


def _find(recordings: list[Recording], kind: Kind, limits: PartLimits) -> list[FoundPoint]:
    """Find the point of each recording, or the corner of two."""
    from dataclasses import replace

    from arctrack.control.part_fitness import fault_of, opening_deg
    from arctrack.recording.found_file import FoundPoint
    from robot_io import Fault
    from tracker.find import Finder, find_joint, found_corner
    from tracker.geometry import SensorGeometry

    joints: dict[str, FoundJoint] = {}
    for recording in recordings:
        if recording.name in joints:
            raise ArctrackError(f"{recording.path}: another recording has that name; rename one of them")
        frames, _ = recording.readable_frames()
        finder = Finder(SensorGeometry.of(recording.setup))
        joints[recording.name] = find_joint(
            finder, recording.posed(frames), "seam" if kind == "corner" else kind
        )
    if kind == "corner":
        joints = {"-".join(joints): found_corner(*joints.values())}
    points = []
    for name, joint in joints.items():
        fault = Fault.NONE if joint.track is None else fault_of(joint.track, limits)
        if fault is not Fault.NONE:
            joint = replace(joint, refusal=fault.name.lower())
        opening = float("nan") if joint.track is None else opening_deg(joint.track.shape)
        points.append(FoundPoint.of(name, joint, opening))
    return points


def _lines(point: FoundPoint) -> list[str]:
    """Return what a found point is told in, or why it is none."""
    refused = f"{point.name}: refused, {point.refusal}" if point.refusal else ""
    if None in point.point_base_mm:
        return [refused]

    def numbers(values: tuple[float | None, ...], digits: int) -> str:
        return ", ".join("unknown" if value is None else f"{value:.{digits}f}" for value in values)

    along_sigma, left_sigma, up_sigma = point.sigma_mm
    known_along = "" if along_sigma is None else f"{along_sigma:.3f} mm along, "
    lines = [
        f"{point.name}: {point.kind} at ({numbers(point.point_base_mm, 3)}) mm in base; sigma {known_along}"
        f"{numbers((left_sigma,), 3)} mm to the left, {numbers((up_sigma,), 3)} mm out of the work",
        f"  along     ({numbers(point.axes_base[0], 4)}), "
        + (
            "the nominal line's: one place does not tell it"
            if None in point.direction_sigma_deg
            else f"sigma {numbers(point.direction_sigma_deg, 3)} deg to the left and out of the work"
        ),
        f"  normal    ({numbers(point.normal_base, 4)}), sigma {numbers((point.normal_sigma_deg,), 3)} deg "
        "about the seam",
        f"  joint     gap {numbers((point.gap_mm,), 3)} mm, mismatch {numbers((point.mismatch_mm,), 3)} mm, "
        f"opening {numbers((point.opening_deg,), 2)} deg",
    ]
    return [*lines, refused] if refused else lines
