"""Free functions of covariates: which one leads, what its band holds, what named effects leave."""

from dataclasses import replace

import numpy as np
import pytest

from noise_model.effects import REGISTRY, Stage
from sim_to_real.evidence.coordinates import ADDED_DN, TOGETHER, form_functions, free_terms, texture
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis, SizeColumns
from sim_to_real.evidence.free_functions import (
    FORMS,
    FreeFunction,
    FreeFunctions,
    all_families,
    covariate_families,
    locate,
    strata_gaps,
)
from sim_to_real.evidence.hypotheses import UnknownCause
from sim_to_real.evidence.metric import Metric
from sim_to_real.evidence.policy import POLICY
from tests.sim_to_real.planted import planted

Z = np.zeros((2, 2), dtype=np.float32)


@pytest.fixture(scope="module")
def bins():
    return planted(n_frames=24, shape=(24, 32))


def noise(bins, seed=1):
    return np.random.default_rng(seed).standard_normal(len(bins.frame))


def compared_of(bins):
    """Some bins, as many in the stripe as off it."""
    places = [np.flatnonzero(bins.in_stripe == in_stripe) for in_stripe in (False, True)]
    return np.sort(np.concatenate([np.random.default_rng(0).permutation(part)[:2000] for part in places]))


def errors_of(bins):
    """Noise alone, in these bins."""
    chosen = bins.subset(compared_of(bins))
    n = len(chosen.frame)
    metric = Metric(np.ones(n, dtype=np.float32), np.zeros((1, n)))
    return ErrorModel(metric, free_terms(chosen), form_functions(chosen), texture(chosen))


def beside_levels(bins, residuals, *further):
    """A hypothesis whose levels of arc, laser and black may be off, with further columns."""
    levels = (0.1 * bins.arc_dn, 0.1 * bins.laser_dn, np.ones_like(bins.arc_dn), *further)
    compared = compared_of(bins)
    columns = SizeColumns.free(np.column_stack(levels)[compared].astype(np.float32))
    return LinearHypothesis(residuals[compared], columns)


def test_a_form_off_elsewhere_is_as_large_as_a_share_of_what_its_effect_does(bins):
    """The mean square over all bins and draws of sizes, for each function of the effect's stage."""
    errors, draw = errors_of(bins), np.random.default_rng(5)
    change = 3.0 * draw.standard_normal(len(compared_of(bins)))
    apart = errors.form_errors_apart("fume", change)
    names = {term.name for term in errors.free_terms.terms if term.stage is Stage.MEDIUM}
    assert len(apart) == len(names - {TOGETHER}) > 1
    for block, size in apart:
        columns = errors.free_terms.columns[block]
        errors_drawn = columns @ (size * draw.standard_normal((columns.shape[1], 400)))
        expected = REGISTRY["fume"].form_rel * np.sqrt(np.mean(change**2))
        assert np.sqrt(np.mean(errors_drawn**2)) == pytest.approx(expected, rel=0.15)


def test_of_several_forms_each_is_as_probable(bins):
    """With one form for each of two effects there is one choice; with two of one effect, their mean."""
    errors, draw = errors_of(bins), np.random.default_rng(6)
    none = beside_levels(bins, noise(bins))
    first, second, third = (
        SizeColumns.free(draw.standard_normal((len(none.residuals), 2)).astype(np.float32)) for _ in range(3)
    )
    both = errors.log_evidence(none, first, second)
    assert errors.log_evidence_off(none, [[first], [second]]) == pytest.approx(both, abs=1e-6)
    nats = [errors.log_evidence(none, form, third) for form in (first, second)]
    mean = np.logaddexp(*nats) - np.log(2.0)
    assert errors.log_evidence_off(none, [[first, second], [third]]) == pytest.approx(mean, abs=1e-6)


def functions_of(bins, residuals, *named):
    none, families = beside_levels(bins, residuals), all_families(bins, compared_of(bins))
    explained = beside_levels(bins, residuals, *named) if named else none
    return FreeFunctions.of(errors_of(bins), families, none, explained, POLICY)


def where(bins, residuals):
    return locate(functions_of(bins, residuals), bins, residuals, "sensor", {"sensor": 1.0}, Z)


def fume(bins):
    """Smoke about the arc dims what passes it (Beer and Lambert), more the nearer a place is to the arc."""
    return bins.arc_dn * np.expm1(-0.4 * np.exp(-np.nan_to_num(bins.values["distance"] - 20.0) / 12.0))


def vignetting(bins):
    """A lens hood: none in the middle, a share that grows with the fourth power towards the rim."""
    return -0.3 * bins.light_dn * (bins.values["radius"] / bins.values["radius"].max()) ** 4


def gamma(bins):
    """A response that is a power of the light."""
    light = bins.predicted_dn - 4.0
    return 255.0 * (light / 255.0) ** 0.9 - light


def laser_drift(bins):
    """A laser that warms up."""
    return 0.15 * bins.laser_dn * np.expm1(-bins.values["time"] / 0.5)


@pytest.mark.parametrize(
    ("gap", "leading", "form", "stage"),
    [
        (fume, {"distance"}, "times_arc", "medium"),
        (vignetting, {"radius", "field_angle"}, "times_light", "optics"),
        (gamma, {"gray_level"}, "adds", "sensor"),
        (laser_drift, {"time"}, "times_laser", "illumination"),
    ],
)
def test_the_covariate_of_a_gap_leads_and_its_stage_is_the_likeliest(bins, gap, leading, form, stage):
    residuals = noise(bins) + gap(bins)
    curves = where(bins, residuals).covariates
    assert curves[0].name in leading
    assert curves[0].form == form
    assert curves[0].r2 > 0.9
    assert curves[0].nats > 50.0
    assert max(curve.nats for curve in curves if curve.name not in leading) < curves[0].nats - 50.0
    errors, none = errors_of(bins), beside_levels(bins, residuals)
    table = errors.table(none, errors.free_blocks)
    evidence = {
        (term.stage, term.name): table.log_evidence(*term.blocks, size=0.1)
        for term in errors.free_terms.terms
    }
    stages = UnknownCause(evidence).stages(POLICY.temperature)
    assert max(stages, key=lambda name: stages[name]) == stage
    assert sum(stages.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "form", "size"),
    [
        ("half_angle", "times_arc", 0.1),
        ("column", "times_laser", 0.1),
        ("distance", "times_arc", 0.03),
        ("row", "adds", 2.0),
        ("gray_level", "adds", 5.0),
        ("time", "times_laser", 0.1),
    ],
)
def test_bands_hold_the_true_curve(bins, name, form, size):
    """In 95 % of all places and draws: waves of any phase and length, levels off by what they may be off."""
    errors = errors_of(bins)
    chosen = bins.subset(compared_of(bins))
    families = covariate_families(name, chosen)
    x = chosen.values[name].astype(np.float64)
    light = FORMS[form](chosen).astype(np.float64) / (ADDED_DN if form == "adds" else 1.0)
    # What levels do is no part of the curve: its mean, and a slope along the grey level.
    n_levels = 2 if name == "gray_level" else 1
    levels = np.vander(np.nan_to_num(x), n_levels) * light[:, np.newaxis]
    held = []
    for seed in range(40):
        draw = np.random.default_rng(seed)
        phase, length = draw.uniform(0.0, 2.0 * np.pi), draw.uniform(0.8, 2.0) * np.ptp(x[np.isfinite(x)])

        def true(at, phase=phase, length=length):
            return size * np.sin(2.0 * np.pi * np.nan_to_num(at) / length + phase)

        off = [0.1, 0.1, 1.0] * draw.standard_normal(3)
        gap = true(x) * light + off[0] * chosen.arc_dn + off[1] * chosen.laser_dn + off[2]
        none = beside_levels(bins, noise(bins, 100 + seed))
        none = replace(none, residuals=none.residuals + gap)
        table = errors.table(none, errors.blocks([SizeColumns.free(family.changes) for family in families]))
        function = {name: FreeFunction.likeliest(table, families, POLICY)}
        curve = FreeFunctions(function, function).curve(name)
        if curve.form == form:
            of_levels = np.linalg.lstsq(levels, true(x) * light, rcond=None)[0]
            expected = true(curve.centers) - np.vander(curve.centers, n_levels) @ of_levels
            held += list((curve.low <= expected) & (expected <= curve.high))
            assert np.median(curve.high - curve.low) < size
    assert len(held) > 35 * len(curve.centers)
    assert 0.92 < np.mean(held) < 0.99


def test_noise_lies_nowhere(bins):
    functions = functions_of(bins, noise(bins))
    place = where(bins, noise(bins))
    assert functions.left_over is None
    assert max(curve.r2 for curve in place.covariates) < 0.1
    assert max(curve.nats for curve in place.covariates) < 2.0
    held = np.concatenate([(c.low <= 0.0) & (c.high >= 0.0) for c in place.covariates])
    assert held.mean() > 0.9
    assert max(value for name, value in place.image.items() if name != "stripe_band") < 0.1
    assert {name for name, gap in place.strata.items() if gap > 0.15} == set()


def test_a_share_is_that_of_the_squares_and_no_more_for_more_functions(bins):
    """Half of the excess lies along the angle, half along nothing: other numbers in each bin."""
    value = bins.values["half_angle"]
    along = (value - value.mean()) / value.std()
    residuals = 2.0 * along + np.random.default_rng(5).normal(0.0, np.sqrt(1.0 + 4.0), len(value))
    functions = functions_of(bins, residuals)
    assert functions.r2("half_angle") == pytest.approx(0.5, abs=0.05)
    # Forty-two functions over the image explain no more by chance than one does.
    assert functions.r2("row, column") < 0.02


def test_frames_own_levels_are_no_function_of_time(bins):
    shares = []
    for seed in range(5):
        level = np.random.default_rng(seed).standard_normal(24)[bins.frame]
        shares.append(functions_of(bins, noise(bins) + 2.0 * level).r2("time"))
    assert np.mean(shares) < 0.25


def test_what_is_named_leaves_the_rest_to_a_free_function(bins):
    drift, dirt = laser_drift(bins), 0.05 * bins.arc_dn * np.sin(bins.values["half_angle"] / 8.0)
    residuals = noise(bins) + drift + dirt
    none = beside_levels(bins, residuals)
    name, closed = functions_of(bins, residuals, drift).left_over
    assert name == "half_angle times_arc"
    # Sizes are roots of the excess of squares that levels leave: that of dirt over that of both.
    compared = compared_of(bins)
    levels = none.columns.changes.astype(np.float64)

    def size(gap):
        return np.linalg.norm(gap[compared] - levels @ np.linalg.lstsq(levels, gap[compared], rcond=None)[0])

    assert closed == pytest.approx(size(dirt) / size(drift + dirt), abs=0.1)
    assert functions_of(bins, residuals, drift, dirt).left_over[1] < 0.05


def test_patterns_of_the_image_are_told_apart(bins):
    ghost = np.stack([bins.image(f, bins.light_dn)[::-1, ::-1] for f in range(24)]).reshape(-1)
    row, column = bins.values["row"], bins.values["column"]
    patch = np.exp(-((row - 6.0) ** 2 + (column - 17.0) ** 2) / 40.0)
    for name, pattern in {
        "row": 3.0 * np.sin(row / 3.0),
        "column": 3.0 * np.sin(column / 4.0),
        "radial": 3.0 * np.cos(bins.values["radius"] / 3.0),
        "mirrored": 0.08 * ghost,
        "fixed": -0.3 * patch * bins.light_dn,
        "stripe_band": np.where(bins.in_stripe, 8.0 * noise(bins, 4), 0.0),
    }.items():
        shares = where(bins, noise(bins) + pattern).image
        # A pattern of rows, of columns or of a radius is one of the image too.
        others = {other: share for other, share in shares.items() if other not in (name, "fixed")}
        assert shares[name] > 0.85, name
        assert max(others.values()) < shares[name] - 0.1, name


def test_what_does_not_vary_or_is_not_known_has_no_curve(bins):
    unknown = np.full_like(bins.values["distance"], np.nan)
    dark = replace(
        bins,
        values={**bins.values, "distance": unknown, "exposure": np.full_like(unknown, 0.005)},
        arc_dn=0.0 * bins.arc_dn,
        laser_dn=0.0 * bins.laser_dn,
    )
    curves = {curve.name: curve for curve in where(dark, noise(dark)).covariates}
    for name in ("distance", "exposure"):
        assert len(curves[name].centers) == 0
        assert curves[name].r2 == curves[name].nats == 0.0
    # Where nothing shines a function can but add.
    assert {curve.form for curve in curves.values()} == {"adds"}


def test_strata_are_told_apart(bins):
    residuals = noise(bins) + np.where(bins.in_stripe, 5.0, 0.0)
    gaps = strata_gaps(bins, residuals)
    assert gaps["stripe_band"] == pytest.approx(5.0, abs=0.1)
    assert gaps["rest"] < 0.15
    assert gaps["dark"] < 0.2 < gaps["laser"] < gaps["stripe_band"]
    no_dark = replace(bins, stratum=np.maximum(bins.stratum, 1).astype(np.int8))
    assert np.isnan(strata_gaps(no_dark, residuals)["dark"])
