"""report.html: a recording's diagnosis on one self-contained page, to be read in two minutes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from arctrack.diagnose.diagnosis_files import PREDICTED_NPZ, REPORT_JSON, WHERE_NPZ
from arctrack.diagnose.pages import cost_words, unknown_words, words
from arctrack.diagnose.pages.words import percent, quantity
from arctrack.output import write_whole
from arctrack.printable import quoted
from arctrack.recording import Recording
from arctrack.report import style
from arctrack.report.embedded import CHANGE, EXCESS, Scale, binned, coloured, png, scale, svg
from arctrack.report.image import visible
from arctrack.report.template import environment
from noise_model.compiled.arrays import Float32, Integers
from noise_model.effects import REGISTRY
from noise_model.instrument.sensor import Sensor
from sim_to_real.diagnosis import (
    Curve,
    Diagnosis,
    DiagnosisVerdict,
    HeldOutPrediction,
    NamedEffect,
    Next,
    RankedEffect,
    excluded_effects,
)

FRAME_PX, MAP_PX = 640, 320
"""Pictures are shrunk to about these widths; a map's pixels are means, which show what noise hides."""

CURVE_LABELS = {
    "adds": "added [DN]",
    "times_arc": "arc light, recorded / predicted",
    "times_laser": "laser light, recorded / predicted",
    "times_light": "light, recorded / predicted",
}
"""Meaning of a free function of each form."""


@dataclass(frozen=True)
class FramePictures:
    """One held-out frame: recorded, predicted before and after, and residuals, on one scale in DN.

    `bin_px` is the bin width of the differences.
    """

    frame: int
    recorded: str
    before: str
    after: str
    left_before: str
    left_after: str
    scale: Scale
    bin_px: int


def telling_frame(predicted: HeldOutPrediction) -> int:
    """Return the place, among the held-out frames, of the one whose gap shrinks most, or is largest."""
    before = _mean_square(predicted.recorded, predicted.before, predicted.variance)
    after = _mean_square(predicted.recorded, predicted.after, predicted.variance_after)
    shrinks = before - after
    return int(np.argmax(shrinks if shrinks.max() > 0.0 else before))


def frame_pictures(predicted: HeldOutPrediction, place: int, sensor: Sensor) -> FramePictures:
    """Return the pictures of the held-out frame at a place of `predicted.frames`."""
    recorded = predicted.recorded[place]
    bin_px = max(1, math.ceil(recorded.shape[1] / MAP_PX))
    differences = []
    for mean, variance in (
        (predicted.before[place], predicted.variance[place]),
        (predicted.after[place], predicted.variance_after[place]),
    ):
        difference = np.where(np.isfinite(variance), recorded - mean, np.nan).astype(np.float32)
        differences.append(binned(difference, bin_px))
    limit = nice_limit(differences[0], 1.0)
    return FramePictures(
        frame=int(predicted.frames[place]),
        recorded=_grey(recorded, sensor),
        before=_grey(predicted.before[place], sensor),
        after=_grey(predicted.after[place], sensor),
        left_before=coloured(differences[0], CHANGE, -limit, limit),
        left_after=coloured(differences[1], CHANGE, -limit, limit),
        scale=scale(CHANGE, -limit, limit),
        bin_px=bin_px,
    )


def residual_map(z: Float32) -> tuple[str, Scale]:
    """Return the map of how far residuals (H, W) exceed their noise, in sigmas, and its scale."""
    shown = binned(z, max(1, math.ceil(z.shape[1] / MAP_PX)))
    limit = nice_limit(shown, 3.0)
    name, low = (CHANGE, -limit) if np.nanmin(shown, initial=0.0) < 0.0 else (EXCESS, 0.0)
    return coloured(shown, name, low, limit), scale(name, low, limit)


def curve_picture(curve: Curve) -> str:
    """Return a free function of a covariate about its mean, with its 95 % band."""
    figure = style.new_figure(5.0, 3.2, f"{quantity(curve.name)}: explains {percent(curve.r2)}")
    axes = style.plain(figure.subplots(), quantity(curve.name, curve.unit), CURVE_LABELS[curve.form])
    neutral = 0.0 if curve.form == "adds" else 1.0
    low, mean, high = (neutral + values for values in (curve.low, curve.mean, curve.high))
    axes.axhline(neutral, color=style.BLACK, linewidth=0.8)
    # A curve of so few points is drawn as points.
    if len(curve.centers) > 3:
        axes.plot(curve.centers, mean, marker="o", markersize=3, color=style.BLUE)
        axes.fill_between(curve.centers, low, high, color=style.SKY, alpha=0.45, linewidth=0)
    else:
        axes.set_xticks(curve.centers)
        axes.errorbar(curve.centers, mean, [mean - low, high - mean], fmt="o", markersize=4, color=style.BLUE)
    return svg(figure)


def nice_limit(values: Float32, least: float) -> float:
    """Return a scale's end: 1, 1.5, 2, 3, 4, 5, 6, 8 or their tenfolds, at least `least`."""
    known = np.abs(values[np.isfinite(values)])
    # The colours reach as far as this share of the pixels.
    reach = max(least, float(np.percentile(known, 99.5)) if known.size else least)
    decade = 10.0 ** math.floor(math.log10(reach))
    return next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15) if step * decade >= reach)


def _mean_square(recorded: Integers, mean: Float32, variance: Float32) -> Float32:
    """Return each frame's mean whitened square (n,), large ones cut."""
    # A few saturated pixels do not choose the frame: none counts for more than 10 sigmas.
    square = np.minimum((recorded - mean) ** 2 / variance, 100.0)
    counts = np.isfinite(variance)
    return np.asarray(np.where(counts, square, 0.0).sum(axis=(1, 2)) / np.maximum(counts.sum(axis=(1, 2)), 1))


def _grey(image_dn: npt.NDArray[np.generic], sensor: Sensor) -> str:
    bin_px = max(1, math.ceil(image_dn.shape[1] / FRAME_PX))
    shown = np.nan_to_num(binned(image_dn.astype(np.float32), bin_px))
    return png(visible(np.rint(shown).clip(0.0, sensor.max_dn).astype(np.uint16), sensor))


ADVICE: Mapping[str, str] = {
    "arc_length": "Check stick-out and arc voltage; if the arc is meant to be so long, state its height in "
    "[arc] center_in_tool_mm.",
    "arc_deflection": "Look for arc blow: the earth clamp's place, magnetised clamps, a worn electrode tip.",
    "arc_radius": "Check electrode tip, shielding gas and current; state the radius in [arc] radius_mm.",
    "arc_flicker": "Check the current source for pulsing and the electrode for wear; expose whole pulses.",
    "argon_line_leak": "Measure the filter's curve (arctrack calibrate filter) or take a narrower one: argon "
    "shines at 696.5 nm.",
    "laser_power_drift": "Let the laser warm up before welding; check its temperature control and supply.",
    "laser_speckle": "Nothing is broken; a wider aperture or a moving diffuser makes the stripe smoother.",
    "uneven_fan": "Look at the stripe on a white board; state the fan's end in [laser] fan_half_angle_deg.",
    "stripe_profile": "Focus the laser at tool height, and state the width in [laser] stripe_sigma_mm.",
    "ambient_light": "Shade the sensor from the hall's lamps, or keep the effect in the setup.",
    "wrong_material": "Check which metal or coating is on the table, and [material] in the setup.",
    "roughness_change": "Check the surface's finish; measure it anew with arctrack calibrate reflectance.",
    "brdf_tail": "Nothing is broken; keep the effect in the setup, or measure the metal anew.",
    "rolling_marks": "Turn the part by 90 deg to confirm; keep the effect in the setup for this sheet.",
    "plate_outline": "Nothing is broken: the plate ends within the view. Keep the effect in the setup.",
    "interreflection": "Nothing is broken: shiny faces light each other. Keep the effect in the setup.",
    "groove_glare": "Nothing is broken: a groove shines from the arc. Keep the effect in the setup.",
    "mirrored_stripe": "Nothing is broken: shiny faces mirror the stripe. Keep the effect in the setup.",
    "fume": "Check fume extraction and gas shielding; look through the window for haze.",
    "spatter": "Check gas flow, current and cleanliness of the metal; the frames it strikes are lost.",
    "spatter_streaks": "Check gas flow and current; a shorter exposure makes the streaks shorter.",
    "hot_metal_glow": "Nothing is broken: metal glows. A shorter exposure or a shorter wavelength sees less.",
    "dirty_window": "Clean or change the protective window.",
    "ghost_stripe": "Look for the laser on torch or fixture, and for a window or filter without coating.",
    "filter_shift": "State the filter's real effective_index in [filter], or tilt and centre it anew.",
    "vignetting": "Look for something that cuts the field's edge: hood, filter mount, an aperture too wide.",
    "defocus": "Focus the lens anew at the stripe's distance.",
    "veiling_glare": "Clean lens and window, and shade the lens from the arc.",
    "exposure_drift": "Switch automatic exposure and gain off; let the camera warm up.",
    "fixed_pattern": "Take a flat field and correct the camera's gains.",
    "blooming": "Shorten the exposure or close the aperture, so that the arc's reflection does not saturate.",
    "gamma": "Switch the camera's gamma or look-up table off, or state the response in [sensor] gamma.",
    "black_level": "Take dark frames and state the offset in [sensor] black_level_dn.",
    "read_noise": "Take dark frames and state the noise in [sensor] read_noise_e; check cable and gain.",
    "image_compression": "Store frames without loss: PNG, or FFV1 as video.",
    "hand_eye": "Check the camera's bracket, then run arctrack calibrate hand-eye.",
    "surface_tilt": "Check how the plate lies in its clamps, and the work object's frame.",
    "lens_distortion": "Calibrate the lens and state [camera] distortion.",
    "pose_delay": "Bring the clocks of robot and camera together; until then keep the delay in the setup.",
}
"""Advice by id, for each effect of the catalogue."""


LABELS = {
    DiagnosisVerdict.NO_GAP: "no gap",
    DiagnosisVerdict.EFFECTS: "gap explained",
    DiagnosisVerdict.AMBIGUOUS: "ambiguous",
    DiagnosisVerdict.UNKNOWN: "unknown cause",
}

LOOK_FURTHER = (
    'See under "Where the gap lies" where it is and what it goes with. Check what was changed last: sensor, '
    "part or setup file."
)

RECOMPUTE = f"""\
import numpy as np

held_out = np.load("{PREDICTED_NPZ}")
for mean, variance in (("before", "variance"), ("after", "variance_after")):
    r = (held_out["recorded"] - held_out[mean]) / np.sqrt(held_out[variance])
    r = r[np.isfinite(held_out[variance])]
    print(mean, np.sqrt(max(np.mean(r**2) - 1.0, 0.0)))
"""
"""Python that computes the gap from the files that were written."""


@dataclass(frozen=True)
class EffectRow:
    """An effect in a table of the page: the share of the gap that it closes, and its probability in words."""

    id: str
    summary: str
    marked: bool
    closed: float
    confidence: str


@dataclass(frozen=True)
class Ranking:
    """A table of effects of one kind: the headings of its columns, and its rows."""

    kind: str
    closes: str
    probability: str
    rows: list[EffectRow]


def write_page(diagnosis: Diagnosis, recording: Recording, without: Sequence[str], path: Path) -> None:
    """Write the page to a file; `without` are the effects that the user left out of the search.

    Raises ArctrackError if it cannot be written.
    """
    write_whole(path, page(diagnosis, recording, without))


def page(diagnosis: Diagnosis, recording: Recording, without: Sequence[str] = ()) -> str:
    """Return the page, which needs no other file and no network."""
    pages = environment()
    pages.globals.update(words=words, Verdict=DiagnosisVerdict)
    return pages.get_template("diagnosis.html.j2").render(**_content(diagnosis, recording, without))


def advice(diagnosis: Diagnosis) -> list[str]:
    """Return the next steps, a line each."""
    lines = []
    if diagnosis.verdict in (DiagnosisVerdict.EFFECTS, DiagnosisVerdict.UNKNOWN):
        lines += [f"{effect.id}: {ADVICE[effect.id]}" for effect in diagnosis.effects]
    if diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS:
        lines += [f"If it is {name}: {ADVICE[name]}" for name in named_effects(diagnosis)]
    if diagnosis.verdict is DiagnosisVerdict.UNKNOWN:
        lines.append(LOOK_FURTHER)
    if diagnosis.next is not None:
        lines.append(_to_record(diagnosis.next, diagnosis.verdict))
    if not lines:
        lines.append("Nothing: the setup fits the recording.")
    return lines


def _to_record(measurement: Next, verdict: DiagnosisVerdict) -> str:
    separates = words.listed(measurement.separates, "from")
    if measurement.reason:
        how_far = "tells apart" if measurement.resolves else "does most, though not all, to tell apart"
        terms = words.listed(measurement.separates, "and")
        return f"Record next: {measurement.experiment}. It {how_far} {terms}: {measurement.reason}."
    if measurement.resolves:
        return f"Record next: {measurement.experiment}. It tells {separates}."
    if verdict is DiagnosisVerdict.UNKNOWN:
        likeliest = f"The likeliest effect, {measurement.separates[0]}, does not explain the gap by itself"
        return f"{likeliest}. To measure it, add {measurement.experiment}."
    return f"No other frames would tell {separates}. Add {measurement.experiment}."


def named_effects(diagnosis: Diagnosis) -> list[str]:
    """Return the effects that the verdict is about: those that it names, and those that fit equally well."""
    ambiguous = (name for ids in diagnosis.ambiguous_with for name in ids)
    return list(dict.fromkeys([*(effect.id for effect in diagnosis.effects), *ambiguous]))


def paste(effects: Sequence[NamedEffect]) -> str:
    """Return the tables that name effects in recording.toml."""
    tables = []
    for effect in effects:
        values = "".join(f"{name} = {float(f'{e.value:.6g}')!r}\n" for name, e in effect.parameters.items())
        tables.append(f"[effects.{effect.id}]\n{values}")
    return "\n".join(tables)


def _content(diagnosis: Diagnosis, recording: Recording, without: Sequence[str]) -> dict[str, Any]:
    setup, predicted = recording.setup, diagnosis.predicted
    shown = None
    if len(predicted.frames):
        shown = frame_pictures(predicted, telling_frame(predicted), setup.sensor)
    z, scale = None, None
    if np.isfinite(diagnosis.where.z).any():
        z, scale = residual_map(diagnosis.where.z)
    curves = [(curve, curve_picture(curve)) for curve in drawn_curves(diagnosis)]
    return {
        "diagnosis": diagnosis,
        "recording": recording,
        "excluded": excluded_effects(setup, without),
        "withheld": words.withheld(diagnosis, without),
        "label": LABELS[diagnosis.verdict],
        "seam": words.seam_sentence(diagnosis, setup.tolerance.seam_mm),
        "bears_mm": setup.tolerance.seam_mm,
        "harmless": cost_words.harmless(diagnosis, setup.tolerance.seam_mm),
        "found_costs": cost_words.found_rows(diagnosis.costs),
        "bound_costs": cost_words.bound_rows(diagnosis.costs),
        "advice": advice(diagnosis),
        "described": unknown_words.described(diagnosis),
        "unknown_curve": _unknown_curve(diagnosis),
        "shown": shown,
        "is_after": shown is not None and shown.before != shown.after,
        "with_what": words.added(diagnosis),
        "map": z,
        "map_scale": scale,
        "curves": curves,
        "rankings": _rankings(diagnosis),
        "strata": _strata(diagnosis),
        "smallest": {name: diagnosis.smallest[name] for name in REGISTRY if name in diagnosis.smallest},
        "paste": paste(diagnosis.effects),
        "shrinks": words.shrinks(diagnosis),
        "best": words.best_alone(diagnosis),
        "same_seam": words.is_same_seam(*diagnosis.gap.seam_mm),
        "apply": f"arctrack diagnose {quoted(recording.path)} --apply",
        "recompute": RECOMPUTE,
        "files": (REPORT_JSON, WHERE_NPZ, PREDICTED_NPZ),
    }


def drawn_curves(diagnosis: Diagnosis) -> list[Curve]:
    """Return the covariates that explain enough of the residual for a picture; none without a gap."""
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        return []
    curves = [curve for curve in diagnosis.where.covariates if len(curve.centers)]
    # Covariates that are drawn at most; report.json has all of them.
    return [curve for curve in curves[:4] if curve.r2 >= words.MIN_R2]


def _unknown_curve(diagnosis: Diagnosis) -> str | None:
    """Return a picture of what an unknown cause depends on most, None where it is worth none."""
    curve = None if diagnosis.unknown is None else diagnosis.unknown.curve
    return None if curve is None or curve.r2 < words.MIN_R2 else curve_picture(curve)


def _rankings(diagnosis: Diagnosis) -> list[Ranking]:
    """Return a table of exclusive effects and one of random ones, which may be there besides."""
    if diagnosis.verdict is DiagnosisVerdict.NO_GAP:
        return []
    # Effects that are listed at most; report.json has all of them.
    exclusive = [candidate for candidate in diagnosis.ranking if not candidate.is_random][:12]
    headings = f"closes {words.IN_BINS}", words.ALONE
    random_headings = f"closes {words.IN_PIXELS}", words.PRESENT
    tables = [
        Ranking("effect", *headings, _rows(diagnosis, exclusive)),
        Ranking("random effect", *random_headings, _rows(diagnosis, words.random_ranking(diagnosis))),
    ]
    return [table for table in tables if table.rows]


def _rows(diagnosis: Diagnosis, candidates: Sequence[RankedEffect]) -> list[EffectRow]:
    marked = named_effects(diagnosis)
    return [
        EffectRow(
            candidate.id,
            words.summary(candidate.id),
            candidate.id in marked,
            candidate.gap_closed if math.isfinite(candidate.gap_closed) else 0.0,
            words.probability(candidate.confidence),
        )
        for candidate in candidates
    ]


def _strata(diagnosis: Diagnosis) -> list[tuple[str, float]]:
    return [(words.STRATA.get(name, name), value) for name, value in diagnosis.where.strata.items()]
