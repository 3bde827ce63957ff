"""Position of the stripe, and what most likely moved it, as quantities and in words."""

import math
from collections.abc import Sequence

from arctrack.calibrate.check.measure import MAX_SIGMAS, LightStage, Measure, SetupVerdict
from arctrack.check.explanations import MIN_PROBABILITY, WeighedCause, explains_as_stated, likely_causes
from arctrack.check.hint import Hint
from calibration.check.stripe_place import StripePlace

UNKNOWN = "nothing known explains it: compare [camera], [laser] and [joint] with the sensor and the part"


def place_measures(place: StripePlace, ranked: Sequence[WeighedCause], hint: Hint | None) -> list[Measure]:
    """Return the stripe's place, and where it is not explained each cause with its probability.

    `ranked` are the explanations of the recording, the likeliest first, `hint` is made of them.
    """
    if explains_as_stated(ranked):
        return [_place(place, SetupVerdict.OK, "")]
    likely = likely_causes(ranked)
    named = SetupVerdict.UNTOLD if len(likely) > 1 else SetupVerdict.NOT_EXPLAINED
    causes = [
        Measure(
            stage=LightStage.PLACE,
            name=each.name,
            measured=math.nan,
            expected=math.nan,
            sigma=math.nan,
            unit="",
            verdict=named if each in likely else SetupVerdict.OK,
            text=f"{100.0 * each.probability:.0f} %",
        )
        for each in ranked
        if each.what and each.probability >= MIN_PROBABILITY
    ]
    return [_place(place, SetupVerdict.NOT_EXPLAINED, UNKNOWN if hint is None else hint.cure), *causes]


def _place(place: StripePlace, verdict: SetupVerdict, cure: str) -> Measure:
    return Measure(
        stage=LightStage.PLACE,
        name="stripe off its place",
        measured=place.off_px,
        expected=0.0,
        sigma=place.off_sigma_px,
        unit="px",
        verdict=verdict,
        cure=cure,
    )


def place_sentences(place: StripePlace, ranked: Sequence[WeighedCause], hint: Hint | None) -> list[str]:
    """Return what is most likely off, what to do, and a recording that would say more."""
    frames = f"{place.n_frames} frame{'s' if place.n_frames > 1 else ''}"
    if explains_as_stated(ranked):
        return [
            f"The stripe lies where the setup puts it in {frames}: {_px(place.off_px)} off. Tolerance and "
            f"the part's place let expect {place.off_sigma_px:.1f} px, 1 σ."
        ]
    if abs(place.off_px) > MAX_SIGMAS * place.off_sigma_px:
        lies = f"The stripe lies {_px(place.off_px)} beside its place in {frames}"
    else:
        lies = f"The stripe's course in {frames} fits no part that lies where parts do"
    if hint is None:
        return [f"{lies}: {UNKNOWN}."]
    sentences = [f"{lies}: most likely {hint.what}.", f"To do: {hint.cure}."]
    if len(likely_causes(ranked)) == 1:
        return sentences
    turned = f"turned by {place.turned_deg:.1f}° and lifted by {place.lifted_mm:.1f} mm"
    return [*sentences, f"The tool was {turned} between these frames. {WHAT_WOULD_TELL}"]


WHAT_WOULD_TELL = (
    "What would tell: ten frames, laser on and arc off, of one plate that stays where it is, the tool turned "
    "by 5° to either side about its x and y axes and lifted by 10 mm between them. A part stays in base, a "
    "sensor goes with the tool."
)


def _px(value: float) -> str:
    return f"{abs(value):.1f} px"
