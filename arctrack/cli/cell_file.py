"""`arctrack cell new` and `arctrack cell check`: the file that holds a cell's choices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.cell import cell
from arctrack.cli.exit_codes import WARNED
from arctrack.cli.inputs import check_can_be_replaced, look_at_cell
from arctrack.cli.simulate import JointName, MaterialName
from arctrack.errors import ArctrackError, in_file
from arctrack.output import check_new_folder, real, write_whole

if TYPE_CHECKING:
    from arctrack.control.cell_file import CellFile, CellJob

__all__ = ["cell"]


@cell.command(epilog="Example: arctrack cell new /tmp/my_cell --joint lap")
def new(
    folder: Annotated[Path, typer.Argument(help="Folder for cell.toml and setup.toml; must not exist yet.")],
    joint: Annotated[JointName, typer.Option(help="The setup's joint.")] = JointName.V_GROOVE,
    material: Annotated[MaterialName, typer.Option(help="The base metal.")] = MaterialName.MILD_STEEL,
) -> None:
    """Write a cell file that explains its keys: bus, camera, gate limits, jobs. A setup lies beside it."""
    check_new_folder(folder)
    from arctrack.control.cell_file.new import write_new_cell

    cell_path, setup_path = write_new_cell(folder, joint.value, material.value)
    typer.echo(f"{cell_path}\n{setup_path}")
    typer.echo(f"Next: state your sensor in {setup_path.name}, then arctrack cell check {cell_path}")


@cell.command(epilog="Example: arctrack cell check /tmp/my_cell/cell.toml")
def check(file: Annotated[Path, typer.Argument(help="The cell file, cell.toml.")]) -> None:
    """Check a cell file and its setup; list each job and the load of the bus.

    The exit code is 1 where the setup has keys that are not known, or the bus is loaded above 70 %.
    """
    look_at_cell(file)
    from arctrack.cli import console
    from arctrack.control.cell_file import read_cell_file
    from arctrack.control.cell_file.choices import HIGH_LOAD

    read = read_cell_file(file)
    typer.echo("\n".join(_lines(read)))
    warnings = list(read.setup.warnings)
    if read.bus_load > HIGH_LOAD:
        warnings.append(f"{file}: the bus is loaded to {100.0 * read.bus_load:.0f} %: what is last may wait")
    console.warn(warnings)
    if warnings:
        raise typer.Exit(WARNED)


@cell.command(epilog="Example: arctrack cell program /tmp/my_cell/cell.toml --job 2 --out fill.csv")
def program(
    file: Annotated[Path, typer.Argument(help="The cell file, cell.toml.")],
    out: Annotated[Path, typer.Option(help="CSV file for the places of the pass.")],
    job: Annotated[
        int | None, typer.Option(help="The job that follows an earlier pass, by its number.")
    ] = None,
) -> None:
    """Write the places of a pass that follows an earlier one, in base, for a robot that takes no offsets.

    Each millimetre has the torch's point, the tool's rotation, their sigma, and what the weld schedule gives.
    The exit code is 1 where the schedule gives nothing for some of them.
    """
    look_at_cell(file)
    check_can_be_replaced(out)
    from collections import Counter

    from arctrack.cli import console
    from arctrack.control.cell_file import read_cell_file
    from arctrack.control.pass_program import pass_program, program_csv

    read = read_cell_file(file)
    number = read.job_numbered(job)
    if read.jobs[number].again is None:
        raise in_file(file, f"[jobs.{number}.again]: missing; state the seam of the pass that it follows")
    if real(out) in map(real, (read.path, read.setup.path, *read.files_read)):
        raise ArctrackError(f"{out}: is of the cell itself; give --out another file")
    points = pass_program(read.jobs[number], read.setup.setup)
    if not points:
        raise in_file(file, f"[jobs.{number}.again] seam: lies past the ends of the job's nominal seam")
    write_whole(out, program_csv(points))
    console.say(f"{out}: {len(points)} places, sigma {max(max(p.sigma_mm) for p in points):.3f} mm at most")
    refusals = Counter(point.weld.refusal for point in points if point.weld.refusal)
    console.warn(
        f"{out}: {n} of {len(points)} places have no weld values: {reason}" for reason, n in refusals.items()
    )
    if refusals:
        raise typer.Exit(WARNED)


def _lines(read: CellFile) -> list[str]:
    from robot_io.protocol.bus_load import frames_per_s

    bus, rate_hz = read.bus, read.camera.frame_rate_hz
    return [
        f"setup: {read.setup.path}, a {read.setup.setup.joint.type} in {read.setup.setup.material.name}",
        f"bus: {bus}, a robot's port"
        if bus.is_port
        else f"bus: {bus} at {bus.bit_rate_bit_s / 1000.0:g} kbit/s; {rate_hz:g} frames of the camera "
        f"make {frames_per_s(rate_hz):.0f} frames on it a second, at most "
        f"{100.0 * read.bus_load:.0f} % of its load",
        *([] if read.camera.kind is None else [f"camera: {read.camera.kind} {read.camera.name}"]),
        *(f"job {number}: {_of_job(read, job)}" for number, job in read.jobs.items()),
    ]


def _of_job(read: CellFile, job: CellJob) -> str:
    from arctrack.recording.seam_file import check_can_keep
    from arctrack.recording.weld_schedule import read_schedule

    parts = [f"{job.name}, a {job.setup_for(read.setup.setup).joint.type}"]
    for name, axis, range_mm in (
        ("y", job.correction.y, read.limits.range_y_mm),
        ("z", job.correction.z, read.limits.range_z_mm),
    ):
        within_mm = min(axis.limit_mm, range_mm)
        bias = f", bias {axis.bias_mm:+g} mm" if axis.bias_mm else ""
        parts.append(f"{name} within {within_mm:g} mm{bias}" if axis.enable else f"{name} not corrected")
    if job.again is not None:
        way = "back along" if job.again.reverse else "along"
        eye = "with" if job.again.laser else "without"
        parts.append(f"{way} {job.again.seam} {eye} the laser")
    if job.keep_seam is not None:
        check_can_keep(job.keep_seam)
        parts.append(f"keeps {job.keep_seam}")
    if job.schedule is not None:
        parts.append(f"welds by {job.schedule}, by {read_schedule(job.schedule).by}")
    if job.bridge_mm is not None:
        parts.append(f"bridges {job.bridge_mm:g} mm")
    required = {
        "gap": (job.part.gap_mm, "mm"),
        "mismatch": (job.part.mismatch_mm, "mm"),
        "depth": (job.part.depth_mm, "mm"),
        "angle": (job.part.angle_deg, "deg"),
    }
    parts += [
        f"{name} {limits[0]:g} to {limits[1]:g} {unit}"
        for name, (limits, unit) in required.items()
        if limits is not None
    ]
    return "; ".join(parts)
