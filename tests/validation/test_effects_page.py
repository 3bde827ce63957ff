"""docs/reference/effects.md: in step with the registry, and pictures that show what they say."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from typer.testing import CliRunner

import noise_model.effects
from arctrack.errors import ArctrackError
from arctrack.nominal import DIMENSIONS
from noise_model.effects import REGISTRY, Effect, Stage
from noise_model.fit import Parameter
from noise_model.forward import Renderer
from noise_model.surface.brdf import TABLE_1
from validation.figures import effect_pictures, effects_page
from validation.figures.__main__ import figures
from validation.figures.effect_pictures import EffectScene, Form

DOCS = Path(__file__).parents[2] / "docs" / "reference"
RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})
RENDERER = Renderer()
SMALL = {"width": 160, "height": 120}

MOONLIGHT = Effect(
    id="moonlight",
    stage=Stage.MEDIUM,
    summary="an even light | from above",
    equation="other += glow_e",
    source="this test",
    parameters=(Parameter("glow_e", "e-", 0.0, 10.0, -1.0, 1e4), Parameter("tint", "", 0.5)),
    typical={"glow_e": 800.0},
)


def shown(effect_id: str) -> EffectScene:
    return EffectScene.of(REGISTRY[effect_id], RENDERER, **SMALL)


def drawn(effect_id: str) -> Figure:
    return effect_pictures.draw(REGISTRY[effect_id], shown(effect_id))


def panels(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(axes.get_images()[0].get_array()) for axes in figure.axes if axes.get_images()]


def what_it_says(path: Path) -> str:
    with Image.open(path) as picture:
        return str(picture.info.get("Description", ""))


def test_the_page_is_in_step() -> None:
    """Make page and pictures anew with: python -m validation.figures effects --out docs/reference."""
    assert (DOCS / effects_page.PAGE).read_text(encoding="utf-8") == effects_page.page(REGISTRY)


def test_each_effect_has_a_picture_of_its_present_values() -> None:
    """Make page and pictures anew with: python -m validation.figures effects --out docs/reference."""
    pictures = {path.stem: path for path in (DOCS / effects_page.PICTURES).iterdir()}
    assert pictures.keys() == REGISTRY.keys()
    for effect in REGISTRY.values():
        path = pictures[effect.id]
        assert what_it_says(path) == effect_pictures.description(effect)
        assert path.stat().st_size <= 60_000, effect.id
    assert sum(path.stat().st_size for path in pictures.values()) <= 1_500_000


def test_a_new_effect_gets_its_section_and_a_place_to_be_shown() -> None:
    text = effects_page.page({**REGISTRY, "moonlight": MOONLIGHT})
    section = text.split("## moonlight\n", 1)[1]
    assert "An even light | from above." in section
    assert "    other += glow_e\n" in section
    assert "- `glow_e`: −1 to 10000 e-; 0 ± 10\n" in section
    assert "- `tint`: −∞ to ∞; 0.5 ± ∞\n" in section
    assert "Source: this test." in section
    assert "(figures/effects/moonlight.png)" in section
    assert "[`moonlight`](#moonlight)" in text


def test_choices_are_places_that_there_are() -> None:
    for chosen in effect_pictures.CHOICES.values():
        assert chosen.joint in DIMENSIONS
        assert chosen.material in TABLE_1
        assert chosen.laser_on or chosen.arc_on


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect_id",
    [pytest.param(name, marks=pytest.mark.slow) if name == "interreflection" else name for name in REGISTRY],
)
def test_each_picture_shows_its_effect(effect_id: str) -> None:
    scene = shown(effect_id)
    arrays = panels(effect_pictures.draw(REGISTRY[effect_id], scene))
    noise_dn = float(np.median(np.sqrt(scene.expected(scene.nominal).variance_dn2)))
    if scene.chosen.form is Form.SINGLE:
        assert len(arrays) == 4
        before, after = arrays[2:]
        assert (after >= before - 1e-9).all()
        assert (after - before).max() > 0.5
    else:
        assert len(arrays) == {Form.EXPECTED: 3, Form.IN_TURN: 10}[scene.chosen.form]
        assert np.abs(arrays[-1]).max() > 3.0 * noise_dn


def test_a_difference_is_the_frames_in_dn() -> None:
    """Frames are drawn by √ of the nominal scale, so squaring them gives back the difference."""
    nominal, changed, change = panels(drawn("vignetting"))
    np.testing.assert_allclose(251.0 * (changed**2 - nominal**2), change, atol=1e-4)
    (offset,) = panels(drawn("black_level"))[2:]
    assert np.median(offset) == pytest.approx(REGISTRY["black_level"].typical["offset_dn"])


def test_frames_share_their_brightness_and_differences_are_even_about_0() -> None:
    figure = drawn("fume")
    limits = [axes.get_images()[0].get_clim() for axes in figure.axes if axes.get_images()]
    assert limits[0] == limits[1] == (0.0, 1.0)
    low, high = limits[2]
    change = np.abs(panels(figure)[2])
    assert low == -high
    assert np.percentile(change, 99.5) <= high <= 2.0 * np.percentile(change, 99.5)


def test_single_frames_scatter_as_predicted() -> None:
    """The pixels' departures from what is expected, in predicted sigmas, have a variance of 1."""
    for effect_id in ("fixed_pattern", "read_noise"):
        scene = shown(effect_id)
        expected = scene.expected(scene.changed)
        frame = scene.single(scene.changed, np.random.default_rng(1))
        z = (frame - expected.mean_dn) / np.sqrt(expected.variance_dn2)
        dark = ~expected.saturated & (expected.mean_dn < 200.0)
        assert np.var(z[dark]) == pytest.approx(1.0, abs=0.1)


def test_a_drift_starts_at_nothing_and_flicker_shows_its_mode() -> None:
    arrays = panels(drawn("laser_power_drift"))
    assert np.abs(arrays[5]).max() < 1e-6
    peaks = [float(array.min()) for array in arrays[6:]]
    assert peaks == sorted(peaks, reverse=True)
    nominal, mode = (panels(drawn("arc_flicker"))[n] for n in (0, 5))
    assert mode.min() >= 0.0
    dim = (nominal > 0.1) & (nominal < 0.4)
    # In the arc's light alone, at the image's top, 1 σ is that share of it.
    share = mode[:20][dim[:20]] / (251.0 * nominal[:20][dim[:20]] ** 2)
    assert np.median(share) == pytest.approx(REGISTRY["arc_flicker"].typical["sigma_rel"], rel=0.02)


def test_a_delayed_pose_moves_the_view() -> None:
    scene = shown("pose_delay")
    moved = scene.T_base_tool(scene.changed)[:3, 3] - scene.T_base_tool(scene.nominal)[:3, 3]
    assert moved[0] == pytest.approx(8.0 * REGISTRY["pose_delay"].typical["delay_s"])
    assert abs(moved[1]) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("effect_id", ["dirty_window", "defocus", "laser_speckle", "arc_flicker"])
def test_nothing_is_cut_off(effect_id: str) -> None:
    figure = drawn(effect_id)
    figure.savefig(os.devnull, format="png")
    texts = [figure._suptitle, figure._supxlabel]
    for axes in figure.axes:
        texts += [axes.title, axes._left_title, axes.yaxis.label]
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    assert len(boxes) >= 5
    for box in boxes:
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0
        assert box.y1 <= figure.bbox.y1
    caption = figure._supxlabel.get_window_extent()
    assert all(axes.get_window_extent().y0 >= caption.y1 for axes in figure.axes)


@pytest.mark.slow
def test_few_colours_are_the_right_ones(tmp_path: Path) -> None:
    effect_pictures.write(drawn("vignetting"), REGISTRY["vignetting"], tmp_path / "few.png")
    drawn("vignetting").savefig(tmp_path / "full.png", format="png")
    few, full = (
        np.asarray(Image.open(tmp_path / name).convert("RGB")).astype(int) for name in ("few.png", "full.png")
    )
    # Where lines of the two maps mix, as at the colour bar's rim, there is no such colour.
    assert np.mean(np.abs(few - full).max(axis=2) <= 6) > 0.995
    assert (few[full.min(axis=2) == 255] == 255).all()


@pytest.mark.slow
def test_the_command_writes_page_and_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noise_model.effects, "REGISTRY", {"black_level": REGISTRY["black_level"]})
    result = RUNNER.invoke(figures, ["effects", "--out", str(tmp_path / "made" / "here")])
    assert result.exit_code == 0, result.output
    assert "effects.md and its pictures" in result.output
    written = sorted(p.relative_to(tmp_path / "made/here") for p in tmp_path.rglob("*.*"))
    assert written == [Path("effects.md"), Path("figures/effects/black_level.png")]
    page = (tmp_path / "made" / "here" / "effects.md").read_text(encoding="utf-8")
    assert "## black_level\n" in page


def test_a_picture_of_other_values_is_told(tmp_path: Path) -> None:
    effect = REGISTRY["black_level"]
    effect_pictures.write(drawn("black_level"), effect, tmp_path / "p.png")
    assert what_it_says(tmp_path / "p.png") == effect_pictures.description(effect)
    other = replace(effect, typical={"offset_dn": 1.0})
    assert what_it_says(tmp_path / "p.png") != effect_pictures.description(other)


def test_help_and_a_folder_that_cannot_be(tmp_path: Path) -> None:
    result = RUNNER.invoke(figures, ["effects", "--help"])
    assert "Example: python -m validation.figures effects" in result.output
    (tmp_path / "file").write_text("")
    with pytest.raises(ArctrackError, match="cannot be written"):
        RUNNER.invoke(figures, ["effects", "--out", str(tmp_path / "file")], catch_exceptions=False)
