"""The result of a diagnosis: is there a gap, where, what causes it, how far it shrinks, what to do next."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from noise_model.compiled.arrays import Float32, Float64, Int64, Integers
from noise_model.effects import not_predicted
from noise_model.setup import Setup


class DiagnosisVerdict(Enum):
    """The verdict on a recording."""

    NO_GAP = "no_gap"
    EFFECTS = "effects"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class ParameterEstimate:
    """A fitted parameter."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class ReportedTrend:
    """Trend of an effect's size within a recording, with a `driver` from `least` to `most`, in `unit`.

    `values` are the parameters' values at the two ends of the driver's range.
    """

    driver: str
    unit: str
    least: float
    most: float
    values: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the verdict names; `share`, 0 to 1, is its part of the gap that all named effects close.

    If its size changes from frame to frame, the parameters are those half-way, and `trend` says how.
    """

    id: str
    stage: str
    confidence: float
    share: float
    parameters: Mapping[str, ParameterEstimate]
    trend: ReportedTrend | None = None


@dataclass(frozen=True)
class RankedEffect:
    """An effect fitted alone, with its probability and the share of the gap that it closes.

    `confidence` is the probability that this effect alone acts; of an effect that `is_random`, that it acts,
    whatever else does. `left_sigma` is what it leaves of the gap, in sigmas of a bin; NaN where unknown.
    """

    id: str
    confidence: float
    gap_closed: float
    is_random: bool = False
    left_sigma: float = math.nan


@dataclass(frozen=True)
class SeamShift:
    """Shift of the tracker's seam along one axis, mm: rms over the run, its 95 % interval, mean shift.

    `value` and `mean` are NaN where only an upper bound `high` is known, all four where no seam was found.
    """

    value: float
    low: float
    high: float
    mean: float


class CostFlag(Enum):
    """Why a cost is unknown."""

    NO_SEAM = "no_seam"
    SEAM_LOST = "seam_lost"
    NOT_RENDERED = "not_rendered"


@dataclass(frozen=True)
class EffectCost:
    """Shift of the tracker's seam by an effect that it does not know, with the effect's parameters `values`.

    Of `n_frames` in which the tracker sees the seam without the effect it loses it in `n_lost`. An effect
    that was not found `is_bound`: what the smallest size that would show costs at most.
    """

    id: str
    lateral_mm: SeamShift
    vertical_mm: SeamShift
    n_frames: int
    n_lost: int
    values: Mapping[str, float]
    is_named: bool = False
    is_bound: bool = False
    is_rendered: bool = True

    @property
    def flag(self) -> CostFlag | None:
        """Why the cost is unknown; None if it is known."""
        if not self.is_rendered:
            return CostFlag.NOT_RENDERED
        if not self.n_frames:
            return CostFlag.NO_SEAM
        return CostFlag.SEAM_LOST if self.n_lost == self.n_frames else None

    @property
    def max_mm(self) -> float:
        """The upper end of the shift, both axes together, mm; inf if it is unknown or the seam is lost."""
        if self.flag is not None or self.n_lost:
            return math.inf
        return math.hypot(self.lateral_mm.high, self.vertical_mm.high)


NO_GAP = "no gap"
"""The name of that hypothesis among those that were compared."""


@dataclass(frozen=True)
class Gap:
    """sqrt(mean r^2 - 1) of whitened residuals on frames held out of the fit, and their rms, DN.

    `floor` is the model's own error. `closed` = (before - after) / (before - floor), with its 95 % interval
    over places of the image; NaN without a gap. `seam_mm` is the rms distance of the tracker's seam from the
    one fitted to all images, for a tracker without the named effects and for one with them, and
    `seam_lateral_mm` and `seam_vertical_mm` are its parts across the seam. `p_nearer` is the
    share of draws of such places in which the prediction after is nearer to the frames than that before, in
    the same sigmas; NaN where no pixel counts.
    """

    before: float
    after: float
    floor: float
    closed: float
    ci95: tuple[float, float]
    rms_dn: tuple[float, float]
    seam_mm: tuple[float, float]
    p_nearer: float
    seam_lateral_mm: tuple[float, float] = (math.nan, math.nan)
    seam_vertical_mm: tuple[float, float] = (math.nan, math.nan)

    @property
    def explains_nothing(self) -> bool:
        """True if the effects' gain on held-out frames is not told from none by its 95 % interval."""
        return self.p_nearer < 0.975

    @property
    def is_clear_after(self) -> bool:
        """True if a clear gap remains after."""
        return self.after > 2.0 * self.floor


@dataclass(frozen=True)
class ModelTest:
    """The global test of the model: the share of quiet recordings that differ from it as much or more.

    `p_values` are those of the tests that it is made of: held_out_gap, bins, scatter.
    """

    p_value: float
    p_values: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Curve:
    """The function of a covariate that explains most of the residual, at knots (k,): mean and 95 % band.

    By its `form` it "adds" DN, or multiplies light as "times_arc", "times_laser" or "times_light", by 1 plus
    the function. It is about its own mean. `r2` is the share that it explains of the excess over all errors,
    `nats` its log evidence over no function. A covariate that does not vary has no knots.
    """

    name: str
    unit: str
    r2: float
    form: str
    nats: float
    centers: Float64
    mean: Float64
    low: Float64
    high: Float64


@dataclass(frozen=True, eq=False)
class Where:
    """Location of the gap.

    `stage` is that of what is named, else the most probable of `stages`, which holds the probability that an
    unknown cause acts at each stage; `covariates` explain the largest share first; `image` holds the shares
    of patterns in the image (row, column, radial, mirrored, fixed, stripe_band); `strata` the gap of dark,
    laser, arc, both frames and of the stripe's band.
    `z` (H, W) is the excess of the held-out residual over its noise, sigmas, negative where a pixel is darker
    than predicted.
    """

    stage: str
    stages: Mapping[str, float]
    covariates: tuple[Curve, ...]
    image: Mapping[str, float]
    strata: Mapping[str, float]
    z: Float32


@dataclass(frozen=True)
class Next:
    """Experiment that would separate effects, or a witness if no experiment `resolves` it.

    Where the cause is unknown it `separates` what the cause may be, in words, and has a `reason`. `certainty`
    is exp(-entropy) of the posterior that is expected after it; NaN where that was not computed.
    """

    experiment: str
    separates: tuple[str, ...]
    resolves: bool
    reason: str = ""
    certainty: float = math.nan


@dataclass(frozen=True)
class UnknownTerm:
    """A free term that an unknown cause may be: any smooth function of a coordinate at a stage.

    `coordinate` is its kind (image, part, time, angle, ...), `source` whose light it changes, `words` both.
    `nats` is its log evidence over nothing unknown, `size` its likeliest prior sigma, `probability` that
    among all terms, `share` the part of what is left unexplained that it explains.
    """

    stage: str
    name: str
    coordinate: str
    source: str
    words: str
    nats: float
    size: float
    probability: float
    share: float


@dataclass(frozen=True, eq=False)
class UnknownDescription:
    """An unknown cause, alone or beside what is named: what it may be, where and when it acts.

    `terms` are the likeliest first. `curve` is the function of one covariate that explains most of what is
    left. `rows_px`, `columns_px`, `along_mm` and `aside_mm` (from the seam, to its left) hold the middle half
    of the excess, NaN where it is not known; `spread` is the share of the view that this box takes. `frames`
    are the fewest frames that hold half of it, of `n_frames`. `excess` is what is left, in sigmas of a bin.
    The fitted seam lies `seam_off_mm` off its stated line (to the left, up), and `sheet_mm` is the
    displacement of the laser's sheet that would move the stripe as that height does.
    """

    terms: tuple[UnknownTerm, ...]
    curve: Curve | None
    rows_px: tuple[float, float]
    columns_px: tuple[float, float]
    along_mm: tuple[float, float]
    aside_mm: tuple[float, float]
    spread: float
    frames: tuple[int, ...]
    n_frames: int
    excess: float
    seam_off_mm: tuple[float, float]
    sheet_mm: float


@dataclass(frozen=True)
class Reason:
    """A hypothesis that was compared: effects, log evidence over no gap, nats, and probability.

    `name` is no gap, an unknown cause with its likeliest stage and term, or the effects. `best` is the
    largest evidence of all.
    """

    name: str
    effects: tuple[str, ...]
    evidence: float
    best: float
    probability: float


@dataclass(frozen=True, eq=False)
class HeldOutPrediction:
    """Held-out frames (n,) as predicted before and after, DN, with the variances (n, H, W), DN^2.

    A variance is inf where a pixel does not count: saturated, on an edge, past the workpiece. Both are the
    same but where effects that scatter are named.
    """

    frames: Int64
    recorded: Integers
    before: Float32
    after: Float32
    variance: Float32
    variance_after: Float32


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """A recording's diagnosis.

    `effects` are those that the verdict names, of an unknown cause those beside which something unknown
    acts; `ranking` are all that were fitted, best first. `ambiguous_with`
    are sets of effects that explain the gap equally well, `not_resolvable` pairs that this recording cannot
    tell apart, `smallest` the smallest magnitude of each effect that would show. `left_over` is the best
    free function of a covariate and the share of the gap that it closes beyond the named effects.
    `after_with` are the effects in the predictions after, whether the verdict names them or not. `reasons`
    are the hypotheses that were compared, the most probable first. `costs` say what each effect does to the
    seam, the largest first, those that were not found last. `model_test` is the global test of the model.
    `unknown` describes the unknown cause of a verdict that has one.
    """

    verdict: DiagnosisVerdict
    effects: tuple[NamedEffect, ...]
    ranking: tuple[RankedEffect, ...]
    ambiguous_with: tuple[tuple[str, ...], ...]
    gap: Gap
    where: Where
    next: Next | None
    not_resolvable: tuple[tuple[str, str], ...]
    smallest: Mapping[str, ParameterEstimate]
    left_over: tuple[str, float] | None
    after_with: tuple[str, ...]
    predicted: HeldOutPrediction
    model_test: ModelTest
    reasons: tuple[Reason, ...] = ()
    costs: tuple[EffectCost, ...] = ()
    unknown: UnknownDescription | None = None


def excluded_effects(setup: Setup, without: Sequence[str]) -> tuple[str, ...]:
    """Return the effects that are no candidates: those withheld, and those of which nothing is predicted."""
    return tuple(dict.fromkeys((*without, *not_predicted(setup))))
