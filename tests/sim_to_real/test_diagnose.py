"""A recording with a hidden effect is diagnosed: what it is, how large, how far the gap shrinks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import SimulationPlan
from noise_model.arc_source import NO_ARC
from noise_model.effects.effect import Stage
from noise_model.surface.brdf import UNSTATED_METAL
from sim_to_real import diagnose as diagnosing
from sim_to_real.diagnose import HeldOut, diagnose, reasons, weaken
from sim_to_real.diagnosis import DiagnosisVerdict, Gap, excluded_effects
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior, UnknownCause
from sim_to_real.evidence.policy import POLICY
from tests.sim_to_real.small import EXACT, example_setup, recorded
from tracker.seam_observations import TRIANGULATION_EFFECTS

pytestmark = pytest.mark.slow

PLAN = SimulationPlan(frames=12, seam_wander_mm=0.1, seed=3)
"""True values are off by their tolerance."""


@pytest.fixture(scope="module")
def with_gamma(tmp_path_factory):
    values = recorded(tmp_path_factory.mktemp("diagnose") / "gamma", {"gamma": {"gamma": 1.3}}, PLAN)
    heard = []
    diagnosis = diagnose(*values, on_stage=lambda text, share: heard.append((text, share)))
    return diagnosis, heard


def test_a_hidden_gamma_is_named_alone_with_its_value(with_gamma):
    result, _ = with_gamma
    assert result.verdict is DiagnosisVerdict.EFFECTS
    assert [effect.id for effect in result.effects] == ["gamma"]
    assert result.effects[0].parameters["gamma"].value == pytest.approx(1.3, abs=0.03)
    assert result.effects[0].share == pytest.approx(1.0)
    assert result.ranking[0].id == "gamma"


def test_it_says_what_the_effects_cost_the_seam(with_gamma):
    """The named one and bounds of the others; the errors of the seam have their two parts."""
    result, _ = with_gamma
    first, *others = result.costs
    assert (first.id, first.is_named, first.is_bound) == ("gamma", True, False)
    assert 0.0 < first.vertical_mm.low <= first.vertical_mm.value <= first.vertical_mm.high < 0.1
    bounds = {cost.id: cost for cost in others if cost.is_bound}
    assert bounds.keys() == TRIANGULATION_EFFECTS & result.smallest.keys()
    assert {"hand_eye", "surface_tilt", "pose_delay"} <= bounds.keys()
    # The tool weaves and rises by some mm/s, and a late clock costs its way.
    speed_mm_s = bounds["pose_delay"].max_mm / abs(bounds["pose_delay"].values["delay_s"])
    assert 3.0 < speed_mm_s < 12.0
    gap = result.gap
    for total, lateral, vertical in zip(gap.seam_mm, gap.seam_lateral_mm, gap.seam_vertical_mm, strict=True):
        assert np.hypot(lateral, vertical) == pytest.approx(total)


def test_the_gap_can_be_computed_again_from_what_was_predicted(with_gamma):
    result, _ = with_gamma
    predicted = result.predicted
    counts = np.isfinite(predicted.variance)
    r = ((predicted.recorded - predicted.before) ** 2 / predicted.variance)[counts]
    assert result.gap.before == pytest.approx(np.sqrt(r.mean() - 1.0), rel=1e-4)
    # An image 106 pixels wide says little of the seam: what is left is its, not the response's.
    assert result.gap.after < 0.5 * result.gap.before
    assert result.gap.ci95[0] <= result.gap.closed <= result.gap.ci95[1]
    assert result.gap.rms_dn[1] < result.gap.rms_dn[0]


def test_it_says_where_and_how_far_it_is(with_gamma):
    result, heard = with_gamma
    assert result.where.stage == "sensor"
    assert result.where.z.shape == result.predicted.before.shape[1:]
    shares = [share for _, share in heard]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_no_frame_with_a_pose_is_refused(tmp_path):
    setup, frames, _ = recorded(tmp_path / "no_pose", {})
    with pytest.raises(ValueError, match="no frame has a pose"):
        diagnose(setup, frames, lambda t: None)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A recording without any effect, of which tests take some frames: setup, frames and pose_at."""
    return recorded(tmp_path_factory.mktemp("diagnose") / "short", {}, replace(PLAN, frames=32))


def test_a_few_frames_of_one_kind_are_enough(short):
    setup, frames, pose_at = short
    diagnosis = diagnose(setup, [frame for frame in frames if frame.laser_on and not frame.arc_on], pose_at)
    assert diagnosis.gap.floor > 0.0


def test_no_stripe_need_be_seen_even_by_a_lens_that_distorts(short):
    setup, frames, pose_at = short
    setup = replace(setup, camera=replace(setup.camera, distortion=(-0.05, 0.01, 0.0, 0.0, 0.0)))
    diagnosis = diagnose(setup, [frame for frame in frames if not frame.laser_on], pose_at)
    assert diagnosis.gap.floor > 0.0


def test_where_no_frame_can_be_held_out_it_is_said(short):
    setup, frames, pose_at = short
    with pytest.raises(ValueError, match="none can be held out"):
        diagnose(setup, frames[:1], pose_at)


def test_where_all_is_saturated_it_is_said(short):
    setup, frames, pose_at = short
    white = [replace(frame, image_dn=np.full_like(frame.image_dn, 255)) for frame in frames]
    with pytest.raises(ValueError, match="nothing can be compared"):
        diagnose(setup, white, pose_at)


def test_where_all_that_the_arc_lights_is_saturated_it_is_said(short):
    setup, frames, pose_at = short
    white = [
        replace(frame, image_dn=np.full_like(frame.image_dn, 255)) if frame.arc_on else frame
        for frame in frames
    ]
    with pytest.raises(ValueError, match="nothing that the arc lights can be compared"):
        diagnose(setup, white, pose_at)


def test_an_effect_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match="gama: no such effect"):
        diagnose(example_setup(), [], lambda t: None, without=("gama",))


def test_bounced_light_in_a_u_is_no_candidate():
    groove, u = (nominal_setup(joint, "mild_steel") for joint in ("v_groove", "u_groove"))
    assert excluded_effects(groove, ("gamma",)) == ("gamma",)
    assert excluded_effects(u, ("gamma",)) == ("gamma", "interreflection")
    assert excluded_effects(u, ("interreflection",)) == ("interreflection",)


def test_what_needs_a_section_that_is_missing_is_no_candidate():
    stated = example_setup()
    no_arc, no_filter, no_metal = (
        replace(stated, **{part: none})
        for part, none in (("arc", NO_ARC), ("filter", None), ("material", UNSTATED_METAL))
    )
    assert "arc_length" in excluded_effects(no_arc, ())
    assert "hot_metal_glow" in excluded_effects(no_arc, ())
    assert excluded_effects(no_filter, ()) == ("argon_line_leak", "filter_shift")
    assert "brdf_tail" in excluded_effects(no_metal, ())
    for setup in (no_arc, no_filter, no_metal):
        assert "ghost_stripe" not in excluded_effects(setup, ())


def test_an_arc_that_nobody_stated_is_refused(short):
    setup, frames, pose_at = short
    with pytest.raises(ValueError, match=r"^\[arc\] is missing: the diagnosis of the \d+ of 32 frames"):
        diagnose(replace(setup, arc=NO_ARC), frames, pose_at)


def test_what_scatters_is_named_beside_what_changes_the_mean(tmp_path):
    spatter = {"rate_per_frame": 8.0, "peak_e": 11_000.0, "length_px": 12.0, "width_px": 1.7}
    hidden = {"spatter": spatter, "arc_length": {"height_mm": 1.0}}
    diagnosis = diagnose(*recorded(tmp_path / "both", hidden, replace(EXACT, frames=16), coarser=3))
    assert {effect.id for effect in diagnosis.effects} == set(hidden)
    reported = diagnosis.predicted
    lit = np.isfinite(reported.variance)
    assert np.mean(reported.variance_after[lit] > 1.5 * reported.variance[lit]) > 0.3


def test_no_reason_has_more_evidence_than_the_best_of_all():
    """Not even an unknown cause beside effects, which has more than these alone."""
    unknown, haze = UnknownCause({(Stage.SENSOR, "rows"): 3.0}), UnknownCause({(Stage.OPTICS, "haze"): 27.0})
    none, gamma = (
        Hypothesis(SimpleNamespace(ids=ids, trend=None), nats, nats, None, {}, beside)
        for ids, nats, beside in (
            ((), 0.0, None),
            (("gamma",), 20.0, haze),
        )
    )
    said = reasons(Posterior.of(none, [gamma], unknown, 10, POLICY))
    assert {reason.name: reason.evidence for reason in said} == {
        "no gap": 0.0,
        "unknown: sensor, rows": 3.0,
        "gamma": 20.0,
        "gamma beside unknown: optics, haze": 27.0,
    }
    assert {reason.best for reason in said} == {27.0}


@pytest.mark.parametrize(
    ("ids", "p_nearer", "idle"),
    [
        (("gamma",), 0.0, ("gamma",)),
        (("gamma",), 0.6, ("gamma",)),
        (("gamma",), 1.0, ()),
        # No pixel counts.
        (("gamma",), np.nan, ()),
        # Nothing was to explain it.
        ((), 0.0, ()),
        # One of two explains nothing that the other does not.
        (("gamma", "fume"), 1.0, ("fume",)),
        (("gamma", "blooming"), 1.0, ()),
    ],
)
def test_effects_that_explain_nothing_of_frames_held_out_are_refuted(monkeypatch, ids, p_nearer, idle):
    """Each is held against all others: the gap below the floor is that of a quiet recording."""
    gap = Gap(0.1334, 0.1332, 0.2, np.nan, (np.nan, np.nan), (1.0, 1.0), (0.1, 0.1), p_nearer)
    for name in ("refit_at", "random_effects", "predict_holdout", "seam_errors_mm"):
        monkeypatch.setattr(diagnosing, name, lambda *_: SimpleNamespace(ids=ids, effects={}))
    monkeypatch.setattr(diagnosing, "measure_gap", lambda *_: gap)
    monkeypatch.setattr(
        HeldOut,
        "gap_without",
        lambda self, name, *_: replace(gap, p_nearer=0.5 if name == "fume" else 1.0),
    )
    fitted = SimpleNamespace(ids=ids, effects={})
    held_out = HeldOut(None, (), None, None, None, fitted, (), lambda *_: None)
    assessed = held_out.assess(SimpleNamespace(leader=SimpleNamespace(refit=fitted)))
    assert assessed.idle == idle
    assert assessed.is_refuted is bool(idle)


@pytest.mark.parametrize(
    ("verdict", "after", "closed", "p_cause", "expected"),
    [
        (DiagnosisVerdict.NO_GAP, 0.3, 0.0, 1.0, DiagnosisVerdict.NO_GAP),
        (DiagnosisVerdict.NO_GAP, 0.5, 0.0, 1.0, DiagnosisVerdict.UNKNOWN),
        (DiagnosisVerdict.EFFECTS, 0.5, 0.95, 0.8, DiagnosisVerdict.EFFECTS),
        (DiagnosisVerdict.EFFECTS, 0.5, 0.85, 0.8, DiagnosisVerdict.UNKNOWN),
        (DiagnosisVerdict.AMBIGUOUS, 0.5, 0.85, 0.8, DiagnosisVerdict.UNKNOWN),
        (DiagnosisVerdict.EFFECTS, 0.5, 0.95, 0.4, DiagnosisVerdict.UNKNOWN),
        # No gap above the floor was there before.
        (DiagnosisVerdict.EFFECTS, 0.1, np.nan, 0.8, DiagnosisVerdict.EFFECTS),
    ],
)
def test_what_is_not_all_is_unknown(verdict, after, closed, p_cause, expected):
    gap = Gap(1.0, after, 0.2, closed, (0.0, 0.0), (1.0, 1.0), (0.1, 0.1), 1.0)
    assert weaken(verdict, gap, p_cause, POLICY) is expected


def test_reasons_say_what_was_compared(with_gamma):
    result, _ = with_gamma
    first, *others = result.reasons
    assert first.effects == ("gamma",)
    assert first.evidence == first.best
    assert first.probability > 0.9
    assert any(reason.name == "no gap" and reason.evidence == 0.0 for reason in others)
    assert any(reason.name.startswith("unknown: ") for reason in others)
    assert sum(reason.probability for reason in result.reasons) <= 1.0 + 1e-9
