"""`benchmarks/policy_sensitivity.py` weighs opened checks anew from their reports alone."""

import json
import tarfile
from pathlib import Path

import pytest

from sim_to_real.diagnose import NO_GAP
from sim_to_real.evidence.policy import POLICY

ROOT = Path(__file__).parents[2]
ARCHIVE = ROOT / "validation" / "archives" / "blind_check_seed73216.tar.xz"


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The opened check with its labels and the last reports, which today's prior odds have judged."""
    folder = tmp_path_factory.mktemp("check")
    with tarfile.open(ARCHIVE) as archive:
        names = sorted(name for name in archive.getnames() if "/results/" in name)[-40:]
        members = [archive.getmember(name) for name in (*names, "seed73216/labels.json")]
        archive.extractall(folder, members, filter="data")
    return folder / "seed73216"


def test_a_posterior_weighed_anew_is_the_reports(opened, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from policy_sensitivity import compared

    weighed = [each.posterior(POLICY) for each in compared(opened)]
    paths = sorted((opened / "results").glob("*.json"))
    told = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    reports = [one["report"] for one in told if one["problem"] is None and one["experiment"] is None]
    assert len(weighed) == len(reports) > 30
    for posterior, report in zip(weighed, reports, strict=True):
        stated = {reason["rule"]: reason["probability"] for reason in report["reasons"]}
        no_gap = next(p for rule, p in stated.items() if rule.startswith(f"evidence of {NO_GAP},"))
        beside = sum(p for rule, p in stated.items() if "unknown" in rule)
        # Reports have six digits.
        assert posterior.p_none == pytest.approx(no_gap, rel=0.01, abs=1e-9)
        assert posterior.p_unknown == pytest.approx(beside, rel=0.03, abs=1e-6)
