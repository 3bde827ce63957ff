"""Position of the stripe, and the part of the setup that would have to be off, as quantities and in words."""

from __future__ import annotations

import math

from arctrack.calibrate.check.measure import MAX_SIGMAS, LightStage, Measure, SetupVerdict
from calibration.check.stripe_place import CAMERA, LASER, LENS, PART, SENSOR, Cause, StripePlace

SUSPECTS = ("hand-eye", "part", "laser plane", "lens")
"""Possible causes, in the order in which they are tried where the stripes do not tell.

A hand-eye goes stale with every other tool frame, torch or contact tip, and a part is laid in anew each time;
laser and lens sit fixed in one housing.
"""

SUSPECT_OF = {CAMERA: "hand-eye", SENSOR: "hand-eye", PART: "part", LASER: "laser plane", LENS: "lens"}

CURES = {
    "hand-eye": "arctrack calibrate hand-eye, in the tool frame that the poses are of",
    "part": "touch the plate with the tip: [joint] seam_in_base_mm, the base frame or the tool's length",
    "laser plane": "arctrack calibrate laser",
    "lens": "arctrack calibrate camera",
}


def place_measures(place: StripePlace) -> list[Measure]:
    """Return the stripe's place, and where it is not explained each suspect with the change that it needs."""
    measures = [
        Measure(
            stage=LightStage.PLACE,
            name="stripe off its place",
            measured=place.off_px,
            expected=0.0,
            sigma=place.off_sigma_px,
            unit="px",
            verdict=SetupVerdict.OK if place.is_explained else SetupVerdict.NOT_EXPLAINED,
            cure="" if place.is_explained else CURES[first_suspect(place)],
        )
    ]
    if place.is_explained:
        return measures
    likely = suspects(place)
    for name in SUSPECTS:
        cause = cause_of(place, name)
        verdict = SetupVerdict.OK
        if name in likely:
            verdict = SetupVerdict.NOT_EXPLAINED if len(likely) == 1 else SetupVerdict.UNTOLD
        measures.append(
            Measure(
                stage=LightStage.PLACE,
                name=f"{name}, if it is that",
                measured=math.nan,
                expected=math.nan,
                sigma=math.nan,
                unit="",
                verdict=verdict,
                cure=CURES[name] if name in likely else "",
                text=_change(cause),
            )
        )
    return measures


def suspects(place: StripePlace) -> tuple[str, ...]:
    """Return the single causes that the stripes cannot separate, the likeliest first."""
    names = {SUSPECT_OF[cause.name] for cause in place.likely}
    return tuple(name for name in SUSPECTS if name in names)


def cause_of(place: StripePlace, suspect: str) -> Cause:
    """Return the likeliest cause of a suspect."""
    return next(cause for cause in place.causes if SUSPECT_OF[cause.name] == suspect)


def first_suspect(place: StripePlace) -> str:
    """Return the most suspect part of a setup that does not explain the stripes."""
    return suspects(place)[0]


def place_sentences(place: StripePlace) -> list[str]:
    """Return the stripes' verdict on camera, laser and hand-eye, and a recording that would say more."""
    frames = f"{place.n_frames} frame{'s' if place.n_frames > 1 else ''}"
    if place.is_explained:
        return [
            f"The stripe lies where the setup puts it in {frames}: {_px(place.off_px)} off. Tolerance and "
            f"the part's place let expect {place.off_sigma_px:.1f} px, 1 σ."
        ]
    likely = suspects(place)
    name = likely[0]
    if abs(place.off_px) > MAX_SIGMAS * place.off_sigma_px:
        lies = f"The stripe lies {_px(place.off_px)} beside its place in {frames}"
    else:
        lies = f"The stripe's course in {frames} fits no part that lies where parts do"
    to_do = f"To do: {CURES[name]}."
    if len(likely) == 1:
        return [f"{lies}: the {name} is not as stated. Nothing else goes so with the poses.", to_do]
    others = ", ".join(f"the {other}" for other in likely[1:])
    turned = f"turned by {place.turned_deg:.1f}° and lifted by {place.lifted_mm:.1f} mm"
    return [
        f"{lies}: most likely the {name} is stale.",
        f"These frames do not tell that from {others}: the tool was {turned} between them. The {name} comes "
        "first by experience.",
        to_do,
        WHAT_WOULD_TELL,
    ]


WHAT_WOULD_TELL = (
    "What would tell: ten frames, laser on and arc off, of one plate that stays where it is, the tool turned "
    "by 5° to either side about its x and y axes and lifted by 10 mm between them. A part stays in base, a "
    "sensor goes with the tool."
)


def _change(cause: Cause) -> str:
    if cause.name == LENS:
        return f"{100.0 * cause.values['ln_focal']:+.1f} % of fx, fy"
    return f"{cause.turn_deg:.2f}° and {cause.move_mm:.1f} mm off"


def _px(value: float) -> str:
    return f"{abs(value):.1f} px"
