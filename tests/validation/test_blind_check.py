"""The blind check: labels sealed, recordings diagnosed without them, opened and scored; a stub renders."""

import json
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from diagnosis_examples import GAMMA, example
from made import level_pose, noise_frames, small_setup
from typer.testing import CliRunner, Result

from arctrack import cli
from arctrack.errors import ArctrackError
from arctrack.recording import read_recording
from noise_model.setup import Setup
from sim_to_real.decision.experiments import MENU, Experiment
from sim_to_real.diagnosis import Diagnosis, DiagnosisVerdict, Next
from tracker.state import Frame
from validation.blind_check import __main__ as main
from validation.blind_check import blind_check as diagnose_check
from validation.blind_check.blind_check import CheckPlan, make, more, open_labels, run, scores_json
from validation.blind_check.plan import RecordingPlan

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
ASKED = CheckPlan(1, 1, "ABE", 3)
PLANNED = (
    RecordingPlan(1, 31, "A", 7, "v_groove", ("gamma",)),
    RecordingPlan(2, 32, "E", 8, "v_groove", ()),
)
MARK = 201
"""The first pixel of a frame that hides gamma, for the stub to find."""

HEARD: list[str] | None = None


def _hear(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and HEARD is not None:
        HEARD.append(str(arguments[0]))


sys.addaudithook(_hear)


@contextmanager
def listening() -> Iterator[list[str]]:
    """Give the names of all files that are opened."""
    global HEARD
    HEARD = heard = []
    try:
        yield heard
    finally:
        HEARD = None


@dataclass
class Calls:
    """What the stubs were asked for; `fault` is raised by the diagnosis of what hides gamma.

    With `asks_for` every run of four frames is ambiguous, and that experiment is asked for.
    """

    made: list[int] = field(default_factory=list)
    continued: list[str] = field(default_factory=list)
    diagnosed: list[tuple[str, ...]] = field(default_factory=list)
    fault: Exception | None = None
    asks_for: str | None = None


@pytest.fixture(autouse=True)
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Let stubs draw, render and diagnose."""
    calls = Calls()
    renderer = types.ModuleType("validation.second_renderer.scenario")
    diagnosis = types.ModuleType("sim_to_real.diagnose")
    baseline = types.ModuleType("validation.blind_check.cosine")

    def draw(seed: int, tier: str, **of: object) -> types.SimpleNamespace:
        return types.SimpleNamespace(
            seed=seed,
            labels={"tier": tier, "effects": list(of["effects"]), "parameters": [0.1 / 3.0]},
            n_run=4,
            n_more=0,
        )

    def followed_by(scenario: types.SimpleNamespace, experiment: Experiment) -> types.SimpleNamespace:
        calls.continued.append(experiment.key)
        return types.SimpleNamespace(**vars(scenario) | {"n_more": 2})

    def render(scenario: types.SimpleNamespace, cache_dir: Path, first: int = 0) -> types.SimpleNamespace:
        calls.made.append(scenario.seed)
        setup = small_setup()
        frames = noise_frames(setup, scenario.n_run + scenario.n_more, scenario.seed)
        frames[0].image_dn[0, 0] = MARK if scenario.labels["effects"] else 0
        times_s = np.arange(-0.2, frames[-1].timestamp_s + 0.3, 0.01)
        poses = [(float(t), level_pose(float(t))) for t in times_s]
        return types.SimpleNamespace(setup=setup, frames=frames[first:], poses=poses, labels=scenario.labels)

    def diagnose(
        setup: Setup,
        frames: Sequence[Frame],
        pose_at: Callable[[float], object],
        *,
        without: Sequence[str],
    ) -> Diagnosis:
        assert pose_at(0.1) is not None
        calls.diagnosed.append(tuple(without))
        hides = frames[0].image_dn[0, 0] == MARK
        if hides and calls.fault is not None:
            raise calls.fault
        if calls.asks_for is not None and len(frames) == 4:
            found = example(DiagnosisVerdict.AMBIGUOUS, setup, GAMMA)
            return replace(found, next=Next(calls.asks_for, ("black_level", "gamma"), True))
        if "gamma" in without:
            return example(DiagnosisVerdict.UNKNOWN, setup, GAMMA)
        return example(DiagnosisVerdict.EFFECTS if hides else DiagnosisVerdict.NO_GAP, setup, GAMMA)

    def cosines(setup: Setup, frames: Sequence[Frame], pose_at: object) -> dict[str, float]:
        return {"fume": -0.9, "gamma": 0.3, "spatter": float("nan")}

    renderer.draw, renderer.make, renderer.followed_by = draw, render, followed_by
    diagnosis.diagnose, baseline.cosines = diagnose, cosines
    for module in (renderer, diagnosis, baseline):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(diagnose_check, "plan", lambda *asked: PLANNED)
    return calls


def quiet(what: str, done: int, of: int) -> None:
    pass


@pytest.fixture
def made(tmp_path: Path) -> Path:
    make(tmp_path / "check", ASKED, 1, quiet)
    return tmp_path / "check"


def command(*arguments: object) -> Result:
    return RUNNER.invoke(main.check, list(map(str, arguments)), catch_exceptions=False)


def change(path: Path, edit: Callable[[dict], None]) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def content_confidence(folder: Path) -> float:
    """The confidence of what the first recording's result names."""
    result = json.loads((folder / "results" / "0001.json").read_text())
    return float(result["report"]["effects"][0]["confidence"])


def test_of_g_what_was_named_is_withheld(
    tmp_path: Path, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        diagnose_check, "plan", lambda *asked: tuple(replace(one, tier="G") for one in PLANNED[:1])
    )
    make(tmp_path / "check", replace(ASKED, tiers="BG"), 1, quiet)
    run(tmp_path / "check", 1, quiet)
    assert sorted(calls.diagnosed) == [(), ("gamma",)]
    rates = {one.id: one.rate for one in open_labels(tmp_path / "check").scores.rates}
    assert (rates["unknown_BG"].right, rates["unknown_BG"].of) == (1, 1)
    assert "unknown_B" not in rates


def test_from_the_making_to_the_table(tmp_path: Path, calls: Calls) -> None:
    folder = tmp_path / "check"
    result = command("make", "--out", folder, "--draws", 1, "--quiet-draws", 1, "--tiers", "ABE", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "2 of 2: 000" in result.stderr
    sealed = (folder / "sealed.json").read_text()
    assert "gamma" not in sealed
    assert sorted(json.loads(sealed)["recordings"]) == ["0001", "0002"]
    assert not (folder / "recordings" / "0001" / "truth.csv").exists()
    result = command("run", folder)
    assert result.exit_code == 0, result.output
    assert "0001: effects gamma" in result.stderr
    assert "0001 without gamma: unknown" in result.stderr
    assert sorted(calls.diagnosed) == [(), (), ("gamma",)]
    result = command("open", folder)
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == (folder / "table.md").read_text().strip()
    lines = result.stdout.splitlines()
    assert (
        "2 recordings planned, 2 made; diagnoses that failed or are missing, counted as wrong: 0." in lines[0]
    )
    assert (
        "| A | named first, alone or beside something unknown | 1 of 1 | 100 % | 21 % to 100 % | 0 % |"
        in lines
    )
    assert "| B | unknown where the effect is withheld | 1 of 1 | 100 % | 21 % to 100 % | 0 % |" in lines
    assert any(line.startswith("| E | false alarms") and "| 0 of 1 | 0 %" in line for line in lines)
    assert "| A | gamma | 1 | 1 | 1 | 0 | 1 |  |  |  |  |" in lines
    content = json.loads((folder / "scores.json").read_text())
    rate = content["scores"]["rates"][0]["rate"]
    assert (rate["right"], rate["of"], rate["share"]) == (1, 1, 1.0)
    assert rate["bounds"] == pytest.approx([0.20654931, 1.0])
    bins = content["scores"]["calibration"]
    assert [one["low"] for one in bins] == [0.0, 0.5, 0.8, 0.9, 0.95, 0.99]
    (held,) = [one for one in bins if one["in_catalogue"]["of"]]
    assert held["low"] < content_confidence(folder) <= held["high"]
    assert held["in_catalogue"]["share"] == 1.0
    assert held["withheld"] == {"right": 0, "of": 0, "share": None, "bounds": [None, None]}
    assert (
        f"| {held['low']:g} to {held['high']:g} | 1 of 1 | 100 % | 21 % to 100 % | 0 of 0 | 100 % |" in lines
    )


@pytest.mark.slow
def test_the_diagnosis_never_opens_the_labels(made: Path) -> None:
    with listening() as heard:
        run(made, 1, quiet)
    assert any(name.endswith("sealed.json") for name in heard)
    assert not [name for name in heard if "labels" in name]
    with listening() as heard:
        open_labels(made)
    assert any(name.endswith("labels.json") for name in heard)


def test_nothing_is_diagnosed_that_is_not_sealed(made: Path, calls: Calls) -> None:
    change(made / "sealed.json", lambda content: content["recordings"].pop("0002"))
    run(made, 1, quiet)
    assert sorted(calls.diagnosed) == [(), ("gamma",)]


def test_an_altered_label_is_found(made: Path) -> None:
    run(made, 1, quiet)

    def alter(content: dict) -> None:
        content["labels"]["0001"]["label"]["effects"] = ["fume"]

    change(made / "labels.json", alter)
    with pytest.raises(
        ArctrackError, match=r"labels\.json: the label of 0001 is not the one that was sealed"
    ):
        open_labels(made)


def test_a_label_sealed_anew_is_found(made: Path) -> None:
    run(made, 1, quiet)
    label = {"tier": "A", "effects": ["fume"]}

    def relabel(content: dict) -> None:
        content["labels"]["0001"] = {"salt": "00", "label": label}

    def reseal(content: dict) -> None:
        content["recordings"]["0001"]["sha256"] = diagnose_check.seal_of("00", label)

    change(made / "labels.json", relabel)
    change(made / "sealed.json", reseal)
    with pytest.raises(ArctrackError, match=r"0001\.json: is the result of a recording with another seal"):
        open_labels(made)


def test_a_lost_label_is_found(made: Path) -> None:
    change(made / "labels.json", lambda content: content["labels"].pop("0002"))
    with pytest.raises(ArctrackError, match="the label of 0002"):
        open_labels(made)


def test_equal_labels_have_different_seals(made: Path, tmp_path: Path) -> None:
    make(tmp_path / "other", ASKED, 1, quiet)
    seals = [json.loads((folder / "sealed.json").read_text()) for folder in (made, tmp_path / "other")]
    assert seals[0]["recordings"]["0001"] != seals[1]["recordings"]["0001"]


def test_making_goes_on_where_it_was_cut_short(tmp_path: Path, calls: Calls) -> None:
    folder = tmp_path / "check"

    def cut(what: str, done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(folder, ASKED, 1, cut)
    assert calls.made == [31]
    kept = json.loads((folder / "labels.json").read_text())["labels"]["0001"]
    (folder / "recordings" / "0002.unfinished" / "frames").mkdir(parents=True)
    (folder / "recordings" / "0002.unfinished" / "frames" / "000000.png").write_bytes(b"half")
    make(folder, ASKED, 1, quiet)
    make(folder, ASKED, 1, quiet)
    assert calls.made == [31, 32]
    assert json.loads((folder / "labels.json").read_text())["labels"]["0001"] == kept
    assert sorted(path.name for path in (folder / "recordings").iterdir()) == ["0001", "0002"]
    run(folder, 1, quiet)
    assert open_labels(folder).n_made == 2


def test_diagnosing_goes_on_where_it_was_cut_short(made: Path, calls: Calls) -> None:
    def cut(what: str, done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(made, 1, cut)
    assert len(calls.diagnosed) == 1
    run(made, 1, quiet)
    run(made, 1, quiet)
    assert len(calls.diagnosed) == 3


def test_another_check_in_the_same_folder_is_refused(made: Path) -> None:
    with pytest.raises(ArctrackError, match="holds a check of draws = 1, quiet_draws = 1, tiers = ABE, seed"):
        make(made, CheckPlan(2, 1, "ABE", 3), 1, quiet)


def test_a_failure_is_a_wrong_answer_and_says_why(made: Path, calls: Calls) -> None:
    calls.fault = TypeError("a fault")
    run(made, 1, quiet)
    opened = open_labels(made)
    assert opened.scores.failures == (("0001", "TypeError: a fault"),)
    rates = {one.id: one.rate for one in opened.scores.rates}
    assert (rates["top1_A"].right, rates["top1_A"].of) == (0, 1)
    assert (rates["false_alarm"].right, rates["false_alarm"].of) == (0, 1)
    assert rates["unknown_B"].of == 0
    assert rates["not_withheld_B"].right == 1
    json.dumps(scores_json(opened), allow_nan=False)


def test_what_was_not_diagnosed_counts_as_wrong(made: Path) -> None:
    run(made, 1, quiet)
    for name in ("0001-without-gamma.json", "0002.json"):
        (made / "results" / name).unlink()
    scores = open_labels(made).scores
    assert scores.failures == (("0002", "not diagnosed"), ("0001 without gamma", "not diagnosed"))
    rates = {one.id: one.rate for one in scores.rates}
    assert (rates["unknown_B"].right, rates["unknown_B"].of) == (0, 1)
    assert (rates["false_alarm"].right, rates["false_alarm"].of) == (1, 1)


RAISED = "the torch raised by 2 mm"


@pytest.fixture
def asking(made: Path, calls: Calls) -> Path:
    """A check whose diagnoses, of the quiet recording too, ask for an experiment."""
    calls.asks_for = RAISED
    run(made, 1, quiet)
    return made


def test_what_is_asked_for_is_measured_and_scored(asking: Path, calls: Calls) -> None:
    result = command("more", asking, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert f"1 of 1: 0001 then {RAISED}: effects gamma" in result.stderr
    # What hides nothing is left out.
    assert (calls.made, calls.continued) == ([31, 32, 31], ["raised"])
    content = json.loads((asking / "results" / "0001-then-raised.json").read_text())
    sealed = json.loads((asking / "sealed.json").read_text())["recordings"]["0001"]["sha256"]
    assert (content["recording"], content["experiment"], content["without"]) == ("0001", RAISED, [])
    assert (content["sealed"], content["problem"]) == (sealed, None)
    result = command("open", asking)
    lines = result.stdout.splitlines()
    assert (
        "| A | named first and for sure with the next experiment (D and H: all and no other) "
        "| 1 of 1 | 100 % | 21 % to 100 % | – |" in lines
    )
    assert any("| a next experiment asked for | 1 of 1 |" in line for line in lines)


def test_a_longer_recording_begins_with_the_recordings_own_frames(asking: Path) -> None:
    more(asking, 1, quiet)
    first, longer = (
        list(read_recording(asking / path).frames())
        for path in ("recordings/0001", "longer/0001-then-raised")
    )
    assert [frame.index for frame in longer] == [0, 1, 2, 3, 4, 5]
    for one, two in zip(first, longer, strict=False):
        np.testing.assert_array_equal(one.image_dn, two.image_dn)
        assert one.timestamp_s == two.timestamp_s


def test_what_is_measured_is_not_measured_again(asking: Path, calls: Calls) -> None:
    more(asking, 1, quiet)
    n_diagnosed = len(calls.diagnosed)
    more(asking, 1, quiet)
    assert (len(calls.continued), len(calls.diagnosed)) == (1, n_diagnosed)
    (asking / "results" / "0001-then-raised.json").unlink()
    more(asking, 1, quiet)
    assert (len(calls.continued), len(calls.diagnosed)) == (1, n_diagnosed + 1)


def test_without_more_nothing_is_measured(asking: Path) -> None:
    rates = {one.id: one.rate for one in open_labels(asking).scores.rates}
    assert (rates["next_resolves"].right, rates["next_resolves"].of) == (0, 0)
    assert (rates["next_missing"].right, rates["next_missing"].of) == (1, 1)


def test_an_experiment_that_is_not_on_the_menu_is_not_measured(made: Path, calls: Calls) -> None:
    calls.asks_for = "look twice"
    assert calls.asks_for not in {experiment.name for experiment in MENU}
    run(made, 1, quiet)
    more(made, 1, quiet)
    assert calls.continued == []
    rates = {one.id: one.rate for one in open_labels(made).scores.rates}
    assert (rates["next_asked"].right, rates["next_witness"].right) == (1, 1)


def test_more_before_any_diagnosis_does_nothing(made: Path, calls: Calls) -> None:
    more(made, 1, quiet)
    assert (calls.continued, list((made / "results").iterdir())) == ([], [])


@pytest.mark.parametrize("step", ["followed_by", "diagnose"])
def test_a_failed_experiment_is_a_wrong_answer_and_says_why(asking: Path, calls: Calls, step: str) -> None:
    def broken(*of: object) -> None:
        raise TypeError("a fault")

    if step == "diagnose":
        calls.fault = TypeError("a fault")
    else:
        sys.modules["validation.second_renderer.scenario"].followed_by = broken
    more(asking, 1, quiet)
    scores = open_labels(asking).scores
    assert scores.failures == ((f"0001 then {RAISED}", "TypeError: a fault"),)
    rates = {one.id: one.rate for one in scores.rates}
    assert (rates["next_resolves"].right, rates["next_resolves"].of) == (0, 1)


def test_another_truth_than_the_sealed_one_is_not_measured(asking: Path, calls: Calls) -> None:
    renderer = sys.modules["validation.second_renderer.scenario"]
    drawn = renderer.draw

    def draw(*of: object, **other: object) -> types.SimpleNamespace:
        scenario = drawn(*of, **other)
        scenario.labels["parameters"] = [0.5]
        return scenario

    renderer.draw = draw
    more(asking, 1, quiet)
    assert calls.continued == []
    ((name, why),) = open_labels(asking).scores.failures
    assert name == f"0001 then {RAISED}"
    assert "the renderer has changed since" in why


def test_a_result_under_another_seal_is_found(asking: Path) -> None:
    more(asking, 1, quiet)
    change(asking / "results" / "0001-then-raised.json", lambda content: content.update(sealed="00"))
    with pytest.raises(ArctrackError, match=r"0001-then-raised\.json: is .* another seal"):
        open_labels(asking)


def test_more_holds_the_labels_against_their_seals(asking: Path, calls: Calls) -> None:
    change(asking / "labels.json", lambda content: content["labels"]["0001"]["label"].update(effects=[]))
    with pytest.raises(ArctrackError, match="the label of 0001 is not the one that was sealed"):
        more(asking, 1, quiet)
    assert calls.continued == []


def test_more_without_the_renderer(asking: Path) -> None:
    def missing(*of: object, **other: object) -> None:
        raise ImportError("No module named 'mitsuba'")

    sys.modules["validation.second_renderer.scenario"].draw = missing
    with pytest.raises(ArctrackError, match=r"pip install 'arctrack\[reference\]'"):
        more(asking, 1, quiet)
    assert not (asking / "results" / "0001-then-raised.json").exists()


def test_several_at_once(made: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    @contextmanager
    def threads(count: int) -> Iterator[Executor]:
        with ThreadPoolExecutor(count) as executor:
            yield executor

    monkeypatch.setattr(diagnose_check, "processes", threads)
    make(tmp_path / "other", ASKED, 2, quiet)
    run(tmp_path / "other", 2, quiet)
    run(made, 1, quiet)
    one, other = (open_labels(folder).scores.rates for folder in (made, tmp_path / "other"))
    assert one == other


def test_checks_of_several_seeds_are_scored_together(made: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    make(other, replace(ASKED, seed=4, tiers="AE"), 1, quiet)
    for folder in (made, other):
        run(folder, 1, quiet)
    (other / "results" / "0001.json").unlink()
    opened = open_labels(made, other)
    assert [one.seed for one in opened.asked] == [3, 4]
    assert (opened.n_planned, opened.n_made) == (4, 4)
    rates = {one.id: one.rate for one in opened.scores.rates}
    assert (rates["top1_A"].right, rates["top1_A"].of) == (1, 2)
    assert (rates["unknown_B"].right, rates["unknown_B"].of) == (1, 1)
    assert opened.scores.failures == (("other/0001", "not diagnosed"),)
    result = command("open", made, other)
    assert result.stdout.startswith(
        "`--draws 1 --quiet-draws 1 --tiers ABE --seed 3 --width-px 640`, `--draws 1 "
    )
    assert not (made / "table.md").exists()


def test_checks_of_one_seed_are_not_scored_together(made: Path) -> None:
    run(made, 1, quiet)
    with pytest.raises(ArctrackError, match=r"is of the seed 3 as is .*check: they share recordings"):
        open_labels(made, made)


def test_without_the_renderer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*of: object, **other: object) -> None:
        raise ImportError("No module named 'mitsuba'")

    sys.modules["validation.second_renderer.scenario"].draw = missing
    with pytest.raises(ArctrackError, match=r"pip install 'arctrack\[reference\]'"):
        make(tmp_path / "check", ASKED, 1, quiet)


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        ArctrackError, match=r"sealed\.json: is missing; run `python -m validation.blind_check make`"
    ):
        command("run", tmp_path)
    monkeypatch.undo()
    with pytest.raises(ArctrackError, match="--tiers AX: tier 'X' is not known"):
        command("make", "--out", tmp_path / "x", "--tiers", "AX")


@pytest.mark.parametrize(
    ("name", "keys", "problem"),
    [
        ("sealed.json", ("recordings",), "[recordings]: missing"),
        ("sealed.json", ("recordings", "0001", "sha256"), "[recordings.0001] sha256: missing"),
        ("labels.json", ("labels",), "[labels]: missing"),
        ("labels.json", ("asked", "seed"), "[asked] seed: missing"),
        ("labels.json", ("labels", "0001", "salt"), "[labels.0001] salt: missing"),
        ("labels.json", ("labels", "0001", "label", "tier"), "[labels.0001.label] tier: missing"),
        ("results/0001.json", ("sealed",), "sealed: missing"),
        ("results/0001.json", ("report",), "there is neither a report nor a problem"),
        ("results/0001.json", ("report", "gap", "floor"), "[report.gap] floor: missing"),
        ("results/0001.json", ("report", "next"), "[report] next: missing"),
    ],
)
def test_a_key_that_a_file_lacks_is_named(made: Path, name: str, keys: tuple[str, ...], problem: str) -> None:
    run(made, 1, lambda *_: None)
    content = json.loads((made / name).read_text())
    table = content
    for key in keys[:-1]:
        table = table[key]
    del table[keys[-1]]
    (made / name).write_text(json.dumps(content))
    with pytest.raises(ArctrackError) as caught:
        open_labels(made)
    assert str(caught.value).startswith(f"{made / name}: is no file of this check: ")
    assert problem in str(caught.value)


def test_a_file_that_holds_no_table_is_named(made: Path) -> None:
    (made / "sealed.json").write_text("[]")
    with pytest.raises(ArctrackError, match=r"sealed\.json: is no file of this check: "):
        run(made, 1, lambda *_: None)


def test_a_folder_named_check_is_a_recording_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = RUNNER.invoke(cli.app, ["diagnose", "./check"])
    assert str(result.exception) == "check: there is no such folder"
    (tmp_path / "check").mkdir()
    result = RUNNER.invoke(cli.app, ["diagnose", "check"])
    assert "recording.toml" in str(result.exception)


def test_help_shows_an_example() -> None:
    result = RUNNER.invoke(main.check, ["--help"])
    assert "Example: python -m validation.blind_check make" in result.output
