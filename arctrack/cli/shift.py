"""`arctrack shift`: how a program must be moved for a part, by points that were found on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from arctrack.cli.inputs import check_can_be_replaced, look_at_file
from arctrack.cli.json_output import json_text
from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from calibration.part_shift import PartShift


def shift(
    master: Annotated[
        Path, typer.Argument(help="File of points found on the master part: arctrack find --out.")
    ],
    part: Annotated[Path, typer.Argument(help="File of the same points, by name, found on this part.")],
    program: Annotated[
        Path | None,
        typer.Option(
            help="CSV of the program's points in base: x_mm, y_mm, z_mm. All of them must be known well "
            "enough; by default the master's points."
        ),
    ] = None,
    within_mm: Annotated[
        float, typer.Option(min=0.0, help="99 % of the program's errors must be within this, mm.")
    ] = 0.25,
    part_mm: Annotated[
        float, typer.Option(min=0.0, help="How far parts' points lie off the master's shape, 1 sigma, mm.")
    ] = 0.0,
    free: Annotated[
        str,
        typer.Option(help="How the part may lie off: some of rx,ry,rz,x,y,z, about and along base's axes."),
    ] = "rx,ry,rz,x,y,z",
    out: Annotated[Path | None, typer.Option(help="JSON file for the shift and its covariance.")] = None,
) -> None:
    """Shift a whole program by points found on a part and on the master part.

    It prints the rigid shift as a frame that the program is moved by, and how well that is known. Points that
    do not determine it are refused, with the kind of point that is missing. One wrong point is named and left
    out.
    The exit code is 0 for a shift, 1 if a point was left out, 3 if it is refused.
    """
    for path in (master, part, *(() if program is None else (program,))):
        look_at_file(path)
    if out is not None:
        check_can_be_replaced(out)
    from arctrack.cli import console
    from arctrack.cli.exit_codes import NOTHING_TRACKED, WARNED
    from arctrack.output import write_whole
    from arctrack.recording.csv_file import number, read_csv
    from arctrack.recording.found_file import found_in_both
    from calibration.part_shift import FREEDOMS, PartPoint, ShiftError, find_shift

    freedoms = tuple(name.strip() for name in free.split(","))
    for name in freedoms:
        if name not in FREEDOMS:
            raise ArctrackError(f"--free {free}: {name} is none of {','.join(FREEDOMS)}")
    points = [
        PartPoint(name, *(point.to_found() for point in both))
        for name, both in found_in_both(master, part).items()
    ]
    columns = dict.fromkeys(("x_mm", "y_mm", "z_mm"), number)
    places_mm = None if program is None else read_csv(program, columns).values
    try:
        result = find_shift(points, places_mm, within_mm, part_mm, freedoms)
    except ShiftError as error:
        console.say(f"refused: {error}")
        raise typer.Exit(NOTHING_TRACKED) from None
    console.say(*_lines(result, len(points)))
    if out is not None:
        write_whole(out, json_text(_content(result)) + "\n")
    if result.wrong is not None:
        raise typer.Exit(WARNED)


def _lines(shift: PartShift, n_points: int) -> list[str]:
    """Return what a shift is, and how well it is known."""
    from scipy.spatial.transform import Rotation

    rotation, wrong = Rotation.from_matrix(shift.T_shift[:3, :3]), shift.wrong
    c_deg, b_deg, a_deg = rotation.as_euler("xyz", degrees=True)
    x, y, z, w = rotation.as_quat(canonical=True)
    x_mm, y_mm, z_mm = shift.T_shift[:3, 3]
    unnoticed = (
        f"one wrong point may move it by {shift.unnoticed_mm:.2g} mm before it is noticed"
        if shift.unnoticed_mm < 1e3
        else "a wrong point would not be noticed: find one more"
    )
    return [
        *([] if wrong is None else [f"left out {wrong}"]),
        f"shift    x {x_mm:.3f}, y {y_mm:.3f}, z {z_mm:.3f} mm in base",
        f"         turned by A {a_deg:.4f}, B {b_deg:.4f}, C {c_deg:.4f} deg about z, y', x''; "
        f"quaternion w x y z {w:.6f} {x:.6f} {y:.6f} {z:.6f}",
        f"sigma    {shift.sigma_mm:.3f} mm at most in the program, {n_points - (wrong is not None)} points",
        f"check    {unnoticed}",
    ]


def _content(shift: PartShift) -> dict[str, Any]:
    """Return the content of a shift's file."""
    return {
        "format": "arctrack-shift/1",
        "T_shift": shift.T_shift.tolist(),
        "center_mm": shift.center_mm.tolist(),
        "covariance": shift.covariance.tolist(),
        "sigma_mm": shift.sigma_mm,
        "unnoticed_mm": shift.unnoticed_mm,
        "chi2": shift.chi2,
        "redundancy": shift.redundancy,
        "wrong": None if shift.wrong is None else shift.wrong._asdict(),
    }
