from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arctrack.recording import read_recording
from arctrack.recording.poses import pose_at
from noise_model.instrument.camera import Camera
from sim_to_real.data.binned import observe
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.locate.covariates import NominalFit, covariates
from sim_to_real.locate.spline_term import CrossValidation, folds_by_turn
from sim_to_real.locate.stage import (
    LEVEL_NUISANCES,
    STAGE_FORMS,
    form_shares,
    linear_columns,
    nonsmooth_shares,
    ranked,
    stages,
)
from tests.sim_to_real.planted import planted
from tests.sim_to_real.small import small_recording

SHARED = Path(__file__).parents[3] / "shared" / "recordings"
CAMERA = Camera(32, 24, 300.0, 300.0, 15.5, 11.5, np.eye(4))
LINEAR = [form for form in STAGE_FORMS if form[1] != "lobe and diffuse"]


def noise(values, seed=1):
    return np.random.default_rng(seed).standard_normal(len(values.frame))


def first(values, r):
    """The stage and the form that come first of those that need no rendering, and all stages' shares."""
    held = CrossValidation.of(values, r, free=LEVEL_NUISANCES)
    columns = linear_columns(held.covariates, values, held.chosen, CAMERA)
    result = ranked(form_shares(held, columns, LINEAR) + nonsmooth_shares(held, values, r))
    return result[0].stage, result[0].form, {of_stage.stage: of_stage.share for of_stage in result}


def level(values, seed=8):
    return 0.2 * np.random.default_rng(seed).standard_normal(values.n_frames)[values.frame]


def patches(values):
    row, column = values.values["row"], values.values["column"]
    return np.cos(row / 4.0) * np.sin(column / 6.0)


PLANTED = {
    ("sensor", "grey level"): lambda of: 4.0 * np.sin(of.values["gray_level"] / 50.0),
    ("sensor", ""): lambda of: 0.1 * of.values["time"] * of.light_dn,
    ("sensor", "level of each frame"): lambda of: level(of) * of.light_dn,
    ("sensor", "noise"): lambda of: 2.0 * noise(of, 3),
    ("optics", "fall-off"): lambda of: -of.light_dn * (of.values["radius"] / 30.0) ** 2,
    ("optics", "factor over the image"): lambda of: 0.3 * of.light_dn * patches(of),
    ("illumination", ""): lambda of: 0.1 * of.values["time"] * of.laser_dn,
    ("illumination", "laser's level of each frame"): lambda of: level(of) * of.laser_dn,
    ("illumination", "laser along its fan"): lambda of: 0.01 * of.values["column"] * of.laser_dn,
    ("illumination", "grain"): lambda of: 0.2 * of.laser_dn * noise(of, 3),
    ("source", "arc's level of each frame"): lambda of: level(of) * of.arc_dn,
    ("source", "arc over the field"): lambda of: of.arc_dn * (of.values["radius"] / 40.0) ** 2,
    ("source", ""): lambda of: of.arc_dn * (of.values["current"] > 120.0) * 0.3,
    ("surface", "arc over half angle"): lambda of: of.arc_dn * np.sin(of.values["half_angle"] / 9.0),
    ("medium", "glow about the arc"): lambda of: np.where(
        of.values["current"] > 0.0,
        of.values["exposure"] * 60000.0 / np.nan_to_num(of.values["distance"], nan=1.0),
        0.0,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "form"), PLANTED)
def test_the_stage_of_a_planted_residual_comes_first(stage, form):
    bins = planted()
    result, found_form, shares = first(bins, noise(bins) + PLANTED[stage, form](bins))
    assert result == stage
    # What goes with time or current is a level of each frame, too.
    assert found_form == form or not form
    assert shares[stage] > 0.8


def test_of_noise_no_stage_explains_much_and_of_a_brighter_lamp_only_its_own():
    bins = planted()
    assert max(first(bins, noise(bins))[2].values()) < 0.15
    tangents = np.zeros_like(bins.tangents)
    tangents[:, 0], tangents[:, 1] = bins.arc_dn, bins.laser_dn
    lamps = tuple(replace(p, prior_sigma=0.1, lower=-0.3, upper=0.3) for p in bins.nuisances[:2])
    bins = replace(bins, tangents=tangents, nuisances=(*lamps, *bins.nuisances[2:]))
    assert first(bins, noise(bins) + 0.8 * bins.arc_dn)[:2] == ("source", "arc's output")
    assert first(bins, noise(bins) + 0.8 * bins.laser_dn)[:2] == ("illumination", "laser's output")


def test_every_stage_is_ranked_and_shares_lie_between_nought_and_one():
    bins = planted()
    _, _, shares = first(bins, 30.0 * noise(bins) + 9.0 * bins.light_dn)
    assert len(shares) == 8
    assert all(0.0 <= share <= 1.0 for share in shares.values())


def test_a_nuisance_that_each_frame_has_its_own_value_of_hides_no_form():
    """As the seam's: fitted to other frames it makes a frame's residuals worse than they were."""
    bins = planted()
    sway = np.sin(1.3 * bins.values["row"]).astype(np.float32)
    tangents = np.zeros_like(bins.tangents)
    tangents[:, 2] = sway
    swaying = replace(bins, tangents=tangents)
    r = noise(bins) + 4.0 * np.sin(bins.values["gray_level"] / 50.0)
    r += np.where(folds_by_turn(bins) < 2, 3.0, -3.0) * sway
    fitted, kept = first(swaying, r), first(replace(bins, tangents=np.zeros_like(tangents)), r)
    assert fitted[:2] == kept[:2] == ("sensor", "grey level")
    assert fitted[2]["sensor"] == pytest.approx(kept[2]["sensor"], rel=0.02)


@pytest.fixture(scope="module")
def longer_arc(tmp_path_factory):
    expected = small_recording(tmp_path_factory.mktemp("stage") / "arc", {"arc_length": {"height_mm": 1.5}})
    return expected, NominalFit.of(expected)


@pytest.mark.slow
def test_an_arc_that_stands_higher_is_found_by_rendering(longer_arc):
    expected, start = longer_arc
    of_stages = stages(expected, [(start, covariates(expected, start))])
    assert (of_stages[0].stage, of_stages[0].form) == ("source", "place of the arc")
    # What nuisances can do themselves, and what bends, is not its.
    assert of_stages[0].share > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "effects"),
    [("geometry", {"surface_tilt": {"roll_deg": 1.5}}), ("timing", {"pose_delay": {"delay_s": 0.06}})],
)
def test_what_moves_otherwise_is_found_by_rendering(stage, effects, tmp_path):
    expected = small_recording(tmp_path / "moved", effects)
    start = NominalFit.of(expected)
    of_stages = stages(expected, [(start, covariates(expected, start))])
    assert of_stages[0].stage == stage
    assert of_stages[0].share > 0.5


@pytest.mark.slow
def test_of_two_fits_that_counts_which_leaves_less(longer_arc):
    expected, start = longer_arc
    good = (start, covariates(expected, start))
    # A fit astray: what it leaves goes with nothing that is there.
    spoiled = replace(start, residuals=start.residuals + 60.0 * level(good[1]) * noise(good[1]))
    bad = (spoiled, good[1])
    best = stages(expected, [good])
    assert stages(expected, [bad]) != best
    assert stages(expected, [bad, good]) == best == stages(expected, [good, bad])


@pytest.mark.skipif(not SHARED.is_dir(), reason="the shared recordings are not here")
def test_another_renderers_hand_eye_error_is_geometry():
    recording = read_recording(SHARED / "v_hand_eye")
    poses = recording.pose_buffer()
    # Eight frames leave open what is the camera's pose and what a bent seam; twelve do not.
    frames = [frame for frame in recording.frames() if frame.index % 2 == 0]
    expected = LinearizedModel(observe(recording.setup, frames, lambda t: pose_at(poses, t)))
    expected.take_tangents(expected.neutral, {})
    fit = refit(expected, {}, expected.neutral)
    assert stages(expected, [(fit, covariates(expected, fit))])[0].stage == "geometry"
