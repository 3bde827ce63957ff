"""report.json, where.npz and predicted.npz against the contract."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnosis_examples import GAMMA, GLARE, example, gap_of

from arctrack.diagnose.diagnosis_files import report, write_numbers
from noise_model.effects import Stage
from noise_model.setup import Setup
from sim_to_real.diagnosis import DiagnosisVerdict

KEYS = ["format", "verdict", "effects", "ranking", "ambiguous_with", "gap", "where", "next", "not_resolvable"]
MORE_KEYS = ["smallest_detectable", "left_over", "after_with", "reasons", "withheld", "cost"]
MORE_KEYS += ["model_test", "unknown"]


@pytest.mark.parametrize("verdict", DiagnosisVerdict)
def test_the_examples_show_what_they_say(verdict: DiagnosisVerdict, seen_setup: Setup) -> None:
    gap = example(verdict, seen_setup).gap
    if verdict is DiagnosisVerdict.NO_GAP:
        assert gap.before < 0.3
    elif verdict is DiagnosisVerdict.UNKNOWN:
        assert gap.after == gap.before > 1.0
    else:
        assert gap.after < 0.3 < 1.0 < gap.before


@pytest.mark.parametrize("verdict", DiagnosisVerdict)
def test_keys_and_types(verdict: DiagnosisVerdict, seen_setup: Setup, tmp_path: Path) -> None:
    write_numbers(example(verdict, seen_setup), tmp_path)
    content = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    assert list(content) == [*KEYS, *MORE_KEYS]
    assert content["format"] == "arctrack-diagnosis/1"
    assert content["verdict"] == verdict.value
    for candidate in content["ranking"]:
        assert list(candidate) == ["id", "confidence", "gap_closed"]
    gap = content["gap"]
    parts = ["rms_dn", "seam_mm", "p_nearer", "seam_lateral_mm", "seam_vertical_mm"]
    assert list(gap) == ["before", "after", "floor", "closed", "ci95", *parts]
    assert all(list(gap[name]) == ["before", "after"] for name in parts if name != "p_nearer")
    where = content["where"]
    assert list(where) == ["stage", "stages", "covariates", "strata", "image", "map"]
    assert where["stage"] in {stage.value for stage in Stage}
    assert where["stages"] == {where["stage"]: 0.96, "timing": 0.035, "geometry": 0.005}
    assert where["covariates"][0] == {"name": "gray_level", "r2": 0.81, "nats": 340.0, "form": "adds"}
    assert where["map"] == "where.npz"
    assert content["not_resolvable"] == [["wrong_material", "fume"], ["arc_length", "arc_radius"]]


def test_what_effects_cost_the_seam(seen_setup: Setup) -> None:
    found, unknown, bound = report(example(DiagnosisVerdict.EFFECTS, seen_setup))["cost"]
    assert found == {
        "id": "gamma",
        "lateral_mm": {"value": 0.0013, "low": 0.0012, "high": 0.0014, "mean": -0.001},
        "vertical_mm": {"value": 0.2117, "low": 0.2, "high": 0.2213, "mean": 0.21},
        "named": True,
        "bound": False,
        "parameters": {"gamma": 0.74},
        "frames": 4,
        "lost": 1,
        "flag": None,
    }
    assert (unknown["flag"], unknown["vertical_mm"]["value"]) == ("not_rendered", None)
    assert bound["vertical_mm"] == {"value": None, "low": 0.0, "high": 0.014, "mean": None}
    assert (bound["bound"], bound["named"], bound["flag"]) == (True, False, None)


def test_what_the_verdict_names(seen_setup: Setup) -> None:
    content = report(example(DiagnosisVerdict.EFFECTS, seen_setup, GAMMA | GLARE))
    assert [effect["id"] for effect in content["effects"]] == ["gamma", "veiling_glare"]
    assert content["effects"][0] == {
        "id": "gamma",
        "stage": "sensor",
        "confidence": 0.997,
        "share": 0.5,
        "parameters": {
            "gamma": {"value": 0.74, "sigma": 0.0074, "unit": ""},
            "bend": {"value": 0.0, "sigma": 0.001, "unit": ""},
        },
    }
    assert list(content["next"]) == ["experiment", "separates", "reason", "certainty"]
    assert content["left_over"] is None
    ambiguous = report(example(DiagnosisVerdict.AMBIGUOUS, seen_setup))
    assert ambiguous["ambiguous_with"] == [["gamma", "black_level"]]
    unknown = report(example(DiagnosisVerdict.UNKNOWN, seen_setup))
    assert (unknown["effects"], unknown["after_with"]) == ([], ["gamma"])
    assert unknown["left_over"] == {"covariate": "half_angle times_arc", "share": 0.62}


def test_what_is_not_known_is_null(seen_setup: Setup) -> None:
    content = report(example(DiagnosisVerdict.NO_GAP, seen_setup))
    assert content["gap"]["closed"] is None
    assert content["gap"]["ci95"] == [None, None]
    assert content["where"]["strata"]["stripe_band"] is None
    assert content["smallest_detectable"]["arc_length"] == {"value": 0.3, "sigma": None, "unit": "mm"}
    assert content["next"] is None
    inf = example(DiagnosisVerdict.EFFECTS, seen_setup)
    inf = replace(inf, gap=replace(inf.gap, seam_mm=(np.float32(0.5), math.inf)))
    assert report(inf)["gap"]["seam_mm"] == {"before": 0.5, "after": None}


def test_anyone_can_recompute_the_gap(seen_setup: Setup, tmp_path: Path) -> None:
    diagnosis = example(DiagnosisVerdict.EFFECTS, seen_setup)
    write_numbers(diagnosis, tmp_path)
    with np.load(tmp_path / "predicted.npz") as held_out:
        arrays = dict(held_out)
    shape = (4, seen_setup.camera.height, seen_setup.camera.width)
    assert arrays["frames"].tolist() == [3, 7, 11, 15]
    for name in ("before", "after", "variance", "variance_after"):
        assert arrays[name].dtype == np.float32
        assert arrays[name].shape == shape
    assert arrays["recorded"].dtype == np.uint8
    assert np.isinf(arrays["variance"]).any()
    gap = json.loads((tmp_path / "report.json").read_text())["gap"]
    before = gap_of(arrays["recorded"], arrays["before"], arrays["variance"])
    after = gap_of(arrays["recorded"], arrays["after"], arrays["variance_after"])
    assert [before, after] == pytest.approx([gap["before"], gap["after"]], rel=1e-5, abs=1e-5)
    with np.load(tmp_path / "where.npz") as where:
        assert where["z"].dtype == np.float32
        assert where["z"].shape == shape[1:]
        assert np.nanmin(where["z"]) >= 0.0
        assert set(np.unique(where["sign"][np.isfinite(where["sign"])])) <= {-1.0, 0.0, 1.0}


def test_an_unknown_cause_is_described(seen_setup: Setup) -> None:
    unknown = report(example(DiagnosisVerdict.UNKNOWN, seen_setup))["unknown"]
    assert unknown["terms"][0] == {
        "stage": "medium",
        "name": "arc over the distance",
        "coordinate": "distance",
        "source": "arc",
        "nats": 90.0,
        "probability": 0.97,
        "share": 0.8,
    }
    assert (unknown["depends_on"]["name"], unknown["depends_on"]["form"]) == ("distance", "times_arc")
    curve = [unknown["depends_on"][key] for key in ("at", "low", "mean", "high")]
    assert all(low < mean < high for _, low, mean, high in zip(*curve, strict=True))
    assert unknown["place"]["rows_px"] == [20.0, 60.0]
    assert unknown["frames"] == [2, 7]
    assert unknown["nearest"][0] == {"id": "gamma", "left": 0.78, "left_sigma": 2.34}
    assert unknown["seam_mm"] == {"off_stated": [0.31, -1.2], "as_sheet": -0.44}
    assert list(unknown["sentences"]) == [
        "it is like",
        "it lies",
        "it comes",
        "it goes with",
        "near to it",
        "the seam",
    ]
    assert report(example(DiagnosisVerdict.EFFECTS, seen_setup))["unknown"] is None
