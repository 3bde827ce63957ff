"""The likeliest mistake in a recording: one likelihood over all known causes.

Each cause is tried on the case: its cure is applied, and three things are measured anew. They are where the
bright lines lie (`calibration.check.stripe_place`, Laplace's evidence), how wide the stripe is, and how many
of the frames the tracker reads. With p the cause's prior,

    ln P = ln p + ln Z(lines) + ln N(ln of the width's ratio) + ln BetaBinomial(frames read) + const.

"Unknown" explains any continuous line, any width and any number of frames read alike. So it wins where no
known cause explains the case, and nowhere else.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from arctrack.check.check_sample import CheckCase
from arctrack.check.mistakes import Mistake, common_mistakes, focal_lengths, other_joints
from arctrack.check.seam_place import SeamPlace
from calibration.check.stripe_place import (
    AS_STATED,
    CAMERA,
    DIMENSION,
    DIMENSION_TOLERANCE,
    DIMENSIONS,
    LASER,
    LENS,
    OFF_NATS,
    PART,
    RIVAL_NATS,
    SENSOR,
    Cause,
    explain_stripes,
    with_changes,
)
from noise_model.arc.scene import make_scene
from noise_model.even_sample import evenly
from noise_model.setup import Setup
from noise_model.transforms import cross
from tracker.geometry import SensorGeometry
from tracker.joint.type_check import JointFamily, family_of
from tracker.stripe.expected import expect_stripe


@dataclass(frozen=True)
class StripeWidth:
    """The stripe's 1 sigma, px, as measured and as a setup has it, NaN where unknown."""

    measured_px: float
    stated_px: float

    @property
    def ln_ratio(self) -> float:
        """Logarithm of measured over stated width, NaN where unknown."""
        return math.log(self.measured_px / self.stated_px)

    def mended(self, case: CheckCase) -> CheckCase:
        """Return the case with the measured width: the sheet's, and the lens' where that alone is wider."""
        camera, laser = case.setup.camera, case.setup.laser
        sheet_px2 = self.stated_px**2 - camera.psf_sigma_px**2
        psf_px = min(camera.psf_sigma_px, 0.9 * self.measured_px)
        sheet = math.sqrt((self.measured_px**2 - psf_px**2) / sheet_px2)
        laser = replace(laser, stripe_sigma_mm=sheet * laser.stripe_sigma_mm)
        return case.with_setup(replace(case.setup, camera=replace(camera, psf_sigma_px=psf_px), laser=laser))


def stripe_width(case: CheckCase) -> StripeWidth:
    """Return the stripe's width in a case's frames, and as its setup has it at the nominal seam."""
    try:
        geometry = SensorGeometry.of(case.setup)
    except ValueError:
        return StripeWidth(case.sigma_px, math.nan)
    widths_px = []
    for T_base_tool in case.T_base_tool:
        scene = make_scene(case.setup, T_base_tool) if np.isfinite(T_base_tool).all() else None
        expected = None if scene is None or scene.below_surface else expect_stripe(geometry, scene)
        if expected is not None:
            widths_px.append(float(np.median(expected.sigma_px)))
    return StripeWidth(case.sigma_px, float(np.median(widths_px)) if widths_px else math.nan)


MOVED_PARTS = (PART, LASER, SENSOR, CAMERA)
STALE_PARTS = (*MOVED_PARTS, LENS, DIMENSIONS)

CURES = {
    LASER: "arctrack calibrate sheet corrects it by a scan of any flat plate",
    **dict.fromkeys(
        (SENSOR, CAMERA), "arctrack calibrate hand-eye measures it, in the tool frame that the poses are of"
    ),
    LENS: "recording.toml: give those of arctrack calibrate camera, in px of this image size",
    PART: "touch the plate with the tip: [joint] seam_in_base_mm, the base frame or the tool's length",
    DIMENSIONS: "recording.toml: state the dimensions that the part has",
}


def stale_part(case: CheckCase, cause: Cause, stated: Setup) -> tuple[str, str, CheckCase]:
    """Return what is wrong by a cause, its cure, and the case without it.

    `stated` is the setup as the user states it, which a case may differ from.
    """
    setup = with_changes(case.setup, cause.values)
    if cause.name == PART:
        setup = _with_part_moved(setup, cause)
    return _in_words(stated, setup, cause), CURES[cause.name], case.with_setup(setup)


def _in_words(stated: Setup, setup: Setup, cause: Cause) -> str:
    if cause.name == LENS:
        return f"[camera] fx, fy: about {setup.camera.fx:.0f} px fit, not {stated.camera.fx:.4g}"
    if cause.name == DIMENSIONS:
        changed = [
            f"{name} about {value:.3g}, not {stated.joint.dimensions[name]:g}"
            for name, value in setup.joint.dimensions.items()
            if abs(cause.values.get(DIMENSION + name, 0.0)) > 2.0 * DIMENSION_TOLERANCE
        ]
        return f"[joint] {'; '.join(changed) or 'its dimensions'}"
    size = f"{cause.move_mm:.1f} mm and {cause.turn_deg:.1f}°"
    named = {
        LASER: f"[laser] plane_in_tool is {size} off",
        SENSOR: f"[camera.pose_in_tool] and [laser] plane_in_tool are together {size} off",
        CAMERA: f"[camera.pose_in_tool] is {size} off",
        PART: f"the part's seam lies {SeamPlace(cause.values['seam_y'], cause.values['seam_z'])}",
    }
    return named[cause.name]


def _with_part_moved(setup: Setup, cause: Cause) -> Setup:
    """Return a setup whose nominal seam lies where a cause puts the part."""
    normal = np.asarray(setup.joint.surface_normal_in_base)
    points = np.asarray(setup.joint.seam_in_base_mm)
    to_left = cross(normal, points[-1] - points[0])
    moved = (
        points + cause.values["seam_y"] * to_left / np.linalg.norm(to_left) + cause.values["seam_z"] * normal
    )
    seam = tuple((float(x), float(y), float(z)) for x, y, z in moved)
    return replace(setup, joint=replace(setup.joint, seam_in_base_mm=seam))


MAX_FITTED = 6
"""Number of common mistakes whose evidence is computed: those that lay most of the lines on the joint."""

MAX_LAID = 6
"""Number of frames whose lines count."""

MAX_TRIED = 6
"""Number of causes whose cure the tracker tries, the likeliest by the lines first."""

READ, READ_UNKNOWN = (4.0, 1.0), (1.0, 1.0)
"""Beta law of the share of frames that the tracker reads: of a right setup, and where nothing is known."""

WIDTH_SPREAD, WRONG_WIDTH_SPREAD = 0.1, 1.0
"""1 sigma of the logarithm of measured over stated width: of a right setup, and of any other."""

LN_PRIOR_STALE, LN_PRIOR_LENS, LN_PRIOR_MISTAKE, LN_PRIOR_UNKNOWN = -2.0, -8.0, -4.0, -4.0
"""ln of the odds to a right setup: of a stale part, of a stale lens, of one mistake, of none of them."""

ORDER_NATS = 0.5
"""Ratio of the probabilities of two mistakes that follow each other in the list of the common ones."""

EQUAL_SHARE = 0.02
"""Shares of the lines on the joint that differ by less are the same."""

MIN_PROBABILITY = 0.005
"""A cause is not listed below this: it would be printed as 0 %."""

POOLED_NATS = 2.0
"""Nats of evidence that count for one in a probability: neighbouring points on one plate err alike."""


@dataclass(frozen=True, eq=False)
class WeighedCause:
    """A cause and its cure, both empty for none; `case` is the one without that mistake, None for "unknown".

    `ln_posterior` is relative to that of the others, `seen` what was measured that shows the cause.
    """

    what: str
    cure: str
    case: CheckCase | None
    ln_posterior: float
    probability: float = math.nan
    seen: str = ""

    @property
    def name(self) -> str:
        """The cause in words."""
        return self.what or ("unknown" if self.case is None else "as stated")

    @property
    def is_as_stated(self) -> bool:
        """True for the explanation that nothing is wrong."""
        return self.case is not None and not self.what

    @property
    def is_read(self) -> bool:
        """True if the tracker reads most frames of the case without the mistake."""
        return self.case is not None and is_read(self.case)


def is_read(case: CheckCase) -> bool:
    """Return whether the tracker reads most frames of a case."""
    return 2 * case.n_read >= len(case.rows)


def explanations(case: CheckCase) -> list[WeighedCause]:
    """Return the explanations of a case, the likeliest first: as stated, each mistake, each part, unknown."""
    width = stripe_width(case)
    untried = sorted(_explained(case, width), key=lambda explanation: -explanation.ln_posterior)
    tried = harmless(case, [_tried(explanation) for explanation in untried[:MAX_TRIED]])
    n = len(case.rows)
    unknown = LN_PRIOR_UNKNOWN + _ln_width(width.ln_ratio, WRONG_WIDTH_SPREAD) + _ln_read(0, n, READ_UNKNOWN)
    tried.append(WeighedCause("", "", None, unknown))
    shares = softmax([explanation.ln_posterior / POOLED_NATS for explanation in tried])
    ranked = [replace(each, probability=float(share)) for each, share in zip(tried, shares, strict=True)]
    return sorted(ranked, key=lambda explanation: -explanation.ln_posterior)


def harmless(case: CheckCase, tried: list[WeighedCause]) -> list[WeighedCause]:
    """Return the causes but those whose cure takes from the tracker the frames that it reads as stated.

    Lines may lie on a glint where the tracker finds the stripe.
    """
    return [each for each in tried if each.is_as_stated or each.is_read] if is_read(case) else tried


def explains_as_stated(ranked: Sequence[WeighedCause]) -> bool:
    """Return whether the setup as stated explains a case, or not much worse than the likeliest cause."""
    least = ranked[0].ln_posterior - OFF_NATS
    return any(each.is_as_stated and each.ln_posterior > least for each in ranked)


def likely_causes(ranked: Sequence[WeighedCause]) -> list[WeighedCause]:
    """Return the causes that cannot be separated from the likeliest; none where nothing known is wrong."""
    if not ranked[0].what or explains_as_stated(ranked):
        return []
    least = ranked[0].ln_posterior - RIVAL_NATS
    return [each for each in ranked if each.what and each.ln_posterior > least]


def _tried(explanation: WeighedCause) -> WeighedCause:
    assert explanation.case is not None
    ln_read = _ln_read(explanation.case.n_read, len(explanation.case.rows), READ)
    return replace(explanation, ln_posterior=explanation.ln_posterior + ln_read)


def _explained(case: CheckCase, width: StripeWidth) -> Iterator[WeighedCause]:
    """Yield what explains the lines and the width, before a cure is tried."""
    ln_width = _ln_width(width.ln_ratio, WIDTH_SPREAD)
    off_px, causes = _causes(case, (AS_STATED, *STALE_PARTS))
    for cause in causes:
        if cause.name != AS_STATED:
            what, cure, mended = stale_part(case, cause, case.setup)
            ln_prior = LN_PRIOR_LENS if cause.name == LENS else LN_PRIOR_STALE
            lies = f"the whole stripe lies {abs(off_px):.1f} px off its place: "
            seen = lies if cause.name in MOVED_PARTS else ""
            yield WeighedCause(what, cure, mended, ln_prior + ln_width + cause.ln_evidence, seen=seen)
            continue
        if SeamPlace(cause.values["seam_y"], cause.values["seam_z"]).is_beyond_search:
            continue
        yield WeighedCause("", "", case, ln_width + cause.ln_evidence)
        if math.isfinite(width.ln_ratio):
            ln_any_width = _ln_width(width.ln_ratio, WRONG_WIDTH_SPREAD)
            yield _wrong_width(case, width, LN_PRIOR_STALE + ln_any_width + cause.ln_evidence)
    for order, (mistake, mended) in enumerate(_on_the_joint(case)):
        for cause in _causes(mended, (AS_STATED,))[1]:
            ln_posterior = LN_PRIOR_MISTAKE - ORDER_NATS * order + ln_width + cause.ln_evidence
            yield WeighedCause(mistake.what, mistake.cure, mended, ln_posterior)
    for lens in _other_lenses(case):
        for cause in _causes(lens, (LENS,))[1]:
            what, cure, mended = stale_part(lens, cause, case.setup)
            yield WeighedCause(what, cure, mended, LN_PRIOR_LENS + ln_width + cause.ln_evidence)
    nats = {cause.name: cause.ln_evidence for cause in causes}
    is_doubtful = nats.get(AS_STATED, -math.inf) < max(nats.values(), default=0.0) - OFF_NATS
    for mistake, mended in _shown_joints(case, is_doubtful):
        for cause in _causes(mended, (DIMENSIONS,))[1]:
            fitted = mended.with_setup(with_changes(mended.setup, cause.values))
            ln_posterior = LN_PRIOR_MISTAKE + ln_width + cause.ln_evidence
            yield WeighedCause(mistake.what, mistake.cure, fitted, ln_posterior)


def _shown_joints(case: CheckCase, is_doubtful: bool) -> Iterator[tuple[Mistake, CheckCase]]:
    """Yield the other types of joints that most of the lines look like which do not look like a plate.

    Of the stated one's own family only if it is doubtful: those whose dimensions fit as well are many.
    """
    families = Counter(line.family for line in case.section_match.lines) if case.fits_camera else Counter()
    own = None if is_doubtful else family_of(case.setup.joint)
    for nothing in (None, JointFamily.FLAT, own):
        families.pop(nothing, None)
    if not families:
        return
    for mistake in other_joints(case.setup.joint):
        mended = mistake.undo(case)
        if mended is not None and family_of(mended.setup.joint) is families.most_common(1)[0][0]:
            yield mistake, mended


def _causes(case: CheckCase, names: Sequence[str]) -> tuple[float, list[Cause]]:
    """Return how far the lines lie off, px, and what explains them by each name, none where no line can."""
    sights = case.stripe_sights
    posed = [sights[n] for n in evenly(len(sights), MAX_LAID)]
    if not posed or not case.fits_camera:
        return math.nan, []
    try:
        return explain_stripes(case.setup, posed, names)
    except ValueError:
        return math.nan, []


def _on_the_joint(case: CheckCase) -> list[tuple[Mistake, CheckCase]]:
    """Return the common mistakes without which most of the lines lie on the joint, the commonest first."""
    undone = _undone(case, common_mistakes(case.T_tool_controllertool))
    best = sorted(undone, key=lambda entry: -entry[0])[:MAX_FITTED]
    return [(mistake, mended) for share, mistake, mended in undone if share >= best[-1][0]]


def _other_lenses(case: CheckCase) -> list[CheckCase]:
    """Return the case with the focal length that lays most of the lines on the joint, none for the stated."""
    undone = _undone(case, focal_lengths(case.setup.camera))
    most = max((share for share, _, _ in undone), default=0.0)
    best = [mended for share, _, mended in undone if share >= most - EQUAL_SHARE]
    return best[len(best) // 2 :][:1]


def _undone(case: CheckCase, mistakes: Iterable[Mistake]) -> list[tuple[float, Mistake, CheckCase]]:
    """Return each mistake without which more of the lines lie on the joint: that share, it, the case."""
    stated = case.section_match.share if case.fits_camera else 0.0
    undone = []
    for mistake in mistakes:
        try:
            mended = mistake.undo(case)
            share = 0.0 if mended is None or not mended.fits_camera else mended.section_match.share
        except ValueError:
            # Numbers that no setup can hold.
            continue
        if mended is not None and share > stated + EQUAL_SHARE:
            undone.append((share, mistake, mended))
    return undone


def _wrong_width(case: CheckCase, width: StripeWidth, ln_posterior: float) -> WeighedCause:
    mended = width.mended(case)
    laser = mended.setup.laser
    what = (
        f"[laser] stripe_sigma_mm: the stripe is {width.measured_px:.3g} px wide, 1 sigma, "
        f"{width.stated_px:.3g} px as stated"
    )
    cure = f"recording.toml: stripe_sigma_mm = {laser.stripe_sigma_mm:.3g} fits, or focus laser and lens"
    return WeighedCause(what, cure, mended, ln_posterior)


def _ln_width(ln_ratio: float, spread: float) -> float:
    # It takes half a second to load: a sound replay asks for none of it.
    from scipy.stats import norm

    return float(norm.logpdf(ln_ratio, scale=spread)) if math.isfinite(ln_ratio) else 0.0


def _ln_read(n_read: int, n: int, law: tuple[float, float]) -> float:
    from scipy.stats import betabinom

    return float(betabinom.logpmf(n_read, n, *law))
