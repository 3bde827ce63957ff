"""The golden replay: stored frames, and what the tracker made of them when it was last changed on purpose.

`python tests/tracker/golden.py --regenerate` writes the reference anew from the stored frames; `--render`
first draws the frames that are not stored.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
from rendered import CURRENT_A, EXPOSURE_S, frame_of, pose_at, small_setup

from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker.seam.correction import UNSTATED, AxisCorrection, Correction
from tracker.state import AT_ONCE, Frame, OffsetLookAhead, Pose, Track
from tracker.tracker import Tracker

HERE = Path(__file__).parent
FRAMES, STRIPES, SEAMS = HERE / "golden", HERE / "golden_stripes.csv", HERE / "golden_seams.csv"

SCANS = slice(None, None, 8)
"""The scan lines whose stripe is compared."""

SEAM = SeamLine(0.0, 1.3, -0.4, 0.01, 0.002)
FAR_ASIDE = SeamLine(0.0, 4.2, -0.4, 0.01, 0.002)


@dataclass(frozen=True)
class Shot:
    """A stored image, the pose it is tracked with, and what is said of its light."""

    image: str
    pose: Pose | None
    laser_on: bool = True
    arc_on: bool = True
    current_a: float = CURRENT_A


@dataclass(frozen=True)
class Case:
    """Shots that one tracker takes in a row; `seam` is where their images were drawn."""

    setup: Setup
    shots: tuple[Shot, ...]
    seam: SeamLine = SEAM
    use_arc_map: bool = True
    correction: Correction = UNSTATED
    lead: OffsetLookAhead = AT_ONCE


def small(joint: str, *, upright: bool = False, **dimensions: float) -> Setup:
    """A setup of 240 x 180 px, its joint with these dimensions."""
    setup = small_setup(joint, upright=upright, width=240)
    return replace(setup, joint=replace(setup.joint, dimensions={**setup.joint.dimensions, **dimensions}))


def three(name: str) -> tuple[Shot, ...]:
    """Three images along the seam, the tool moved and turned a little at each."""
    turns = ((0, 0, 0), (1.0, -1.0, 1.0), (-1.0, 2.0, 0.5))
    return tuple(
        Shot(f"{name}_{n}", pose_at(4.0 * n, 0.2 * n, -0.1 * n, turn)) for n, turn in enumerate(turns)
    )


def ten_bit(setup: Setup) -> Setup:
    return replace(setup, sensor=replace(setup.sensor, bits=10))


def arc_aside(setup: Setup, y_mm: float) -> Setup:
    """The setup with its arc stated so far to the left of where it was drawn."""
    x, y, z = setup.arc.center_in_tool_mm
    return replace(setup, arc=replace(setup.arc, center_in_tool_mm=(x, y + y_mm, z)))


V_GROOVE = (
    Shot("v_groove_0", pose_at(0.0)),
    Shot("v_groove_1", pose_at(8.0, 0.5, -0.5, (1.0, -2.0, 2.0))),
)
FILLET = three("fillet")
AFTER = pose_at(12.0)
LIGHT_EFFECTS = {"veiling_glare": {"share": 0.1, "spread": 0.3}, "hot_metal_glow": {"peak_e": 30000.0}}

CASES: dict[str, Case] = {
    "v_groove": Case(
        small_setup("v_groove"),
        (
            *V_GROOVE,
            Shot("v_groove_0", None),
            Shot("v_groove_0", replace(AFTER, extrapolated=True)),
            # The seam jumps by 1 mm, and comes back.
            Shot("v_groove_0", pose_at(14.0, 1.0)),
            Shot("v_groove_0", pose_at(16.0), current_a=float("nan")),
        ),
    ),
    "v_groove_10_bit": Case(ten_bit(small_setup("v_groove")), V_GROOVE),
    "v_groove_without_map": Case(small_setup("v_groove"), V_GROOVE, use_arc_map=False),
    "v_groove_upright": Case(
        small_setup("v_groove", upright=True),
        (Shot("v_groove_upright_0", pose_at(4.0)), Shot("v_groove_upright_0", pose_at(6.0))),
    ),
    "v_groove_light_effects": Case(
        replace(small("v_groove"), effects=LIGHT_EFFECTS), three("v_groove_light_effects")[:2]
    ),
    "lap": Case(small_setup("lap"), (Shot("lap_0", pose_at(0.0)), Shot("lap_0", pose_at(2.0)))),
    "corrugation": Case(small_setup("corrugation"), (Shot("corrugation_0", pose_at(-10.0)),) * 2),
    "u_groove": Case(
        small("u_groove"),
        (*three("u_groove")[:2], Shot("u_groove_no_arc", AFTER, arc_on=False)),
        seam=FAR_ASIDE,
    ),
    "half_v": Case(
        small("half_v", upright=True),
        (
            *three("half_v")[:2],
            Shot("half_v_no_laser", pose_at(8.0), laser_on=False),
            Shot("half_v_no_laser", pose_at(10.0)),
            Shot("half_v_3", AFTER),
        ),
    ),
    "fillet": Case(small("fillet"), FILLET),
    "fillet_against_map": Case(arc_aside(small("fillet"), 15.0), FILLET),
    "butt": Case(
        small("butt"),
        three("butt"),
        correction=Correction(when_lost="hold", y=AxisCorrection(gain=0.8, limit_mm=0.5)),
        lead=OffsetLookAhead(0.02, 0.4),
    ),
    "butt_closed": Case(small("butt", gap_mm=0.1), three("butt_closed")),
    "edge": Case(small("edge"), three("edge")),
}


def stored(image: str) -> Path:
    return FRAMES / f"{image}.png"


def replay(case: Case) -> Iterator[Track]:
    """The track of each of a case's shots."""
    tracker = Tracker(case.setup, case.use_arc_map, case.correction)
    for index, shot in enumerate(case.shots):
        image = cv2.imread(str(stored(shot.image)), cv2.IMREAD_UNCHANGED)
        assert image is not None, shot.image
        image_dn = image.astype(case.setup.sensor.dtype)
        light = EXPOSURE_S, shot.current_a, shot.laser_on, shot.arc_on
        yield tracker.step(Frame(index, 0.1 * index, image_dn, *light), shot.pose, case.lead)


def numbers_of(track: Track) -> dict[str, float]:
    """What is compared of a track beside its flags; a pair's parts are left and right."""
    numbers = {f"seam_{axis}_mm": value for axis, value in zip("xyz", track.seam_tool_mm, strict=True)}
    for name in (
        *("sigma_y_mm", "sigma_z_mm", "confidence"),
        *("offset_y_mm", "offset_z_mm", "offset_sigma_y_mm", "offset_sigma_z_mm", "offset_confidence"),
        *("valid_at_s", "arc_level", "map_misfit", "fov_margin_mm", "gap_mm", "mismatch_mm"),
    ):
        numbers[name] = getattr(track, name)
    for name, value in track.shape._asdict().items():
        sides = {f"left_{name}": value[0], f"right_{name}": value[1]} if isinstance(value, tuple) else {}
        numbers |= sides or {name: value}
    return numbers


def stripe_of(track: Track) -> list[tuple[int, float, float]]:
    """The scan line, the position and its sigma, px, of every few lines; none where no stripe was read."""
    if track.stripe is None:
        return []
    position_px, sigma_px = track.stripe.position_px, track.stripe.sigma_px
    scans = range(len(position_px))[SCANS]
    return [(scan, float(position_px[scan]), float(sigma_px[scan])) for scan in scans]


def render() -> None:
    for case in CASES.values():
        for index, shot in enumerate(case.shots):
            if shot.pose is None or stored(shot.image).exists():
                continue
            laser, arc = float(shot.laser_on), float(shot.arc_on)
            frame = frame_of(case.setup, shot.pose, case.seam, laser=laser, arc=arc, index=index)
            cv2.imwrite(str(stored(shot.image)), frame.image_dn, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def regenerate() -> None:
    with STRIPES.open("w", newline="") as stripes, SEAMS.open("w", newline="") as seams:
        write_stripe, write_seam = csv.writer(stripes), csv.writer(seams)
        write_stripe.writerow(["case", "frame", "scan", "position_px", "sigma_px"])
        for name, case in CASES.items():
            for track in replay(case):
                numbers = numbers_of(track)
                if seams.tell() == 0:
                    write_seam.writerow(["case", "frame", "flags", *numbers])
                values = (f"{value:.8f}" for value in numbers.values())
                write_seam.writerow([name, track.frame, " ".join(track.flag_names), *values])
                for scan, *px in stripe_of(track):
                    write_stripe.writerow([name, track.frame, scan, *(f"{value:.8f}" for value in px)])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--regenerate", action="store_true", help="write the reference anew")
    parser.add_argument("--render", action="store_true", help="draw the frames that are not stored")
    options = parser.parse_args()
    if options.render:
        render()
    if options.regenerate:
        regenerate()
