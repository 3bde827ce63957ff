"""The check of a setup by a recording: looks at some frames, and judges what they show stage by stage."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from arctrack.calibrate.check.light_measures import arc_measures, sensor_measures, stripe_measures
from arctrack.calibrate.check.measure import MAX_SIGMAS, LightStage, Measure, SetupVerdict
from arctrack.check.check_recording import parted, sensor_of
from arctrack.check.check_sample import case_of, chosen_rows
from arctrack.check.explanations import (
    MIN_PROBABILITY,
    WeighedCause,
    explains_as_stated,
    explanations,
    likely_causes,
)
from arctrack.check.hint import Hint, hint_of
from arctrack.check.look import CheckedFrame, looks_at
from arctrack.compiling import compiled_by_two
from arctrack.errors import in_file
from arctrack.recording import BadFrame, Recording
from arctrack.recording.reader import fitted
from calibration.check.arc_light import ArcLightCheck, compare_arc
from calibration.check.stripe_place import StripePlace, StripeSight, locate_stripes
from noise_model.compiled.arrays import Float64
from noise_model.even_sample import evenly
from noise_model.setup import Setup
from noise_model.surface.joint import NOMINAL_SEAM
from tracker.geometry import SensorGeometry
from tracker.seam.correction import UNSTATED
from tracker.state import Frame
from tracker.warm_up import warm_up

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


@dataclass(frozen=True, eq=False)
class SetupCheck:
    """Check of a setup by a recording: quantities by stage, and verdicts.

    `place` and `arc` are None where no frame determines them, which `sentences` explain. `hint` is the
    likeliest mistake where the stripe is not as stated, and `mended` the stripe's place without it. `sights`
    are the stripes of `looks` that were compared.
    """

    recording: Recording
    measures: tuple[Measure, ...]
    place: StripePlace | None
    hint: Hint | None
    mended: StripePlace | None
    arc: ArcLightCheck | None
    looks: tuple[CheckedFrame, ...]
    sights: tuple[StripeSight, ...]
    sentences: tuple[str, ...]
    bad_frames: tuple[BadFrame, ...]

    @property
    def setup(self) -> Setup:
        """The setup that was checked."""
        return self.recording.setup

    @property
    def not_explained(self) -> tuple[LightStage, ...]:
        """The stages at which the setup does not explain the recording."""
        return tuple(stage for stage in LightStage if self.verdict_of(stage) is SetupVerdict.NOT_EXPLAINED)

    def verdict_of(self, stage: LightStage) -> SetupVerdict:
        """Return a stage's verdict: that of its worst quantity, and none without a determined one."""
        verdicts = {measure.verdict for measure in self.measures if measure.stage is stage}
        for verdict in (SetupVerdict.NOT_EXPLAINED, SetupVerdict.OK):
            if verdict in verdicts:
                return verdict
        return SetupVerdict.UNTOLD

    @property
    def headline(self) -> str:
        """Overall verdict, in a line."""
        if not self.not_explained:
            explained = [stage.value for stage in LightStage if self.verdict_of(stage) is SetupVerdict.OK]
            return f"the setup explains the recording: {'; '.join(explained) or 'nothing could be explained'}"
        parts = []
        for stage in self.not_explained:
            if stage is LightStage.PLACE and self.place is not None:
                likely = f"most likely {self.hint.what}" if self.hint else "the stripe lies elsewhere"
                parts.append(likely)
            else:
                names = [
                    m.name
                    for m in self.measures
                    if m.stage is stage and m.verdict is SetupVerdict.NOT_EXPLAINED
                ]
                parts.append(f"{stage.value}: {', '.join(names)}")
        return f"the setup does not explain the recording: {'; '.join(parts)}"


def check_setup(recording: Recording, on_frame: Callable[[int], None] | None = None) -> SetupCheck:
    """Check the setup that a recording was read with; ArctrackError where it can track no such frames."""
    fitted(recording)
    try:
        geometry = SensorGeometry.of(recording.setup)
    except ValueError as error:
        raise in_file(recording.setup_path, str(error)) from None
    frames, bad_frames = parted(recording.frames(chosen_rows(recording)))
    with compiled_by_two(geometry.setup):
        warm_up(geometry, UNSTATED)
    looks = looks_at(recording, geometry, frames, on_frame)
    sights = sights_of(geometry, looks)
    place, problem = _placed(recording.setup, sights)
    case = None if place is None else case_of(recording)
    ranked = [] if case is None else explanations(case)
    hint = hint_of(ranked)
    mended = None
    if hint is not None and hint.case is not None:
        mended, _ = _placed(hint.case.setup, hint.case.stripe_sights)
    arc, arc_sentences = _arc_seen(recording, mended or place)
    measures = sensor_measures(recording.setup, sensor_of(recording, looks), arc)
    stripe_sentences = problem
    if place is not None and ranked:
        measures += place_measures(place, ranked, hint)
        stripe_sentences = place_sentences(place, ranked, hint)
    measures += stripe_measures(recording.setup, looks, _first(measures))
    measures += arc_measures(recording.setup, arc, _first(measures))
    return SetupCheck(
        recording=recording,
        measures=tuple(measures),
        place=place,
        hint=hint,
        mended=mended,
        arc=arc,
        looks=tuple(looks),
        sights=sights,
        sentences=(*stripe_sentences, *arc_sentences),
        bad_frames=tuple(bad_frames),
    )


def _placed(setup: Setup, sights: Sequence[StripeSight]) -> tuple[StripePlace | None, list[str]]:
    """Return the stripes' place, None where nothing determines it, and why."""
    if not sights:
        return None, ["Camera, laser and hand-eye are not told: no frame with the laser on shows a line."]
    try:
        return locate_stripes(setup, sights), []
    except ValueError as error:
        return None, [f"Camera, laser and hand-eye are not told: {error}."]


def _arc_seen(recording: Recording, place: StripePlace | None) -> tuple[ArcLightCheck | None, list[str]]:
    """Return the arc's light against the expected one, None where nothing determines it, and remarks."""
    lit = _arc_frames(recording)
    if not lit:
        return None, ["The arc is not told: no frame with the arc on."]
    setup, seam = recording.setup, NOMINAL_SEAM
    if place is not None:
        setup, seam = place.fitted_setup, place.seam
    try:
        return compare_arc(setup, lit, seam), []
    except ValueError as error:
        return None, [f"The arc is not told: {error}."]


def _first(measures: Sequence[Measure]) -> str:
    """Return the first correction, of the earliest stage; nothing where all explain the recording."""
    wrong = [
        m for m in measures if m.verdict is SetupVerdict.NOT_EXPLAINED and m.stage is not LightStage.STRIPE
    ]
    return wrong[0].stage.value if wrong else ""


def sights_of(geometry: SensorGeometry, looks: Sequence[CheckedFrame]) -> tuple[StripeSight, ...]:
    """Return the stripes of the looks that have a pose and show a line."""
    return tuple(_sight(geometry, look) for look in looks if look.pose is not None and len(look.line.scan))


def _sight(geometry: SensorGeometry, look: CheckedFrame) -> StripeSight:
    """Return the stripe as the tracker read it, or else the bright line that was found without any model."""
    assert look.pose is not None
    stripe = look.track.stripe
    # A stripe that the tracker holds in fewer scan lines is taken from the bright line instead.
    if stripe is None or np.isfinite(stripe.position_px).sum() < 30:
        return StripeSight(look.line.points_px, look.pose.T_base_tool)
    scan = np.flatnonzero(np.isfinite(stripe.position_px))
    points_px = geometry.image_points(scan.astype(np.float64), stripe.position_px[scan])
    return StripeSight(points_px, look.pose.T_base_tool)


def _arc_frames(recording: Recording) -> list[tuple[Frame, Float64]]:
    """Return frames with the arc on, over the whole run, with their poses (4, 4)."""
    lit = np.flatnonzero([row.arc_on and row.current_a != 0.0 for row in recording.rows])
    # Number of frames with the arc on that are compared with the arc map.
    frames, _ = parted(recording.frames(lit[evenly(len(lit), 12)].tolist()))
    return [(frame, pose.T_base_tool) for frame, pose in recording.posed(frames)]
