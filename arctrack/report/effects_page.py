"""docs/reference/effects.md, made from the registry of effects: what each does, in words and a picture."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from arctrack.report import effect_pictures
from noise_model.effects import Effect, Stage
from noise_model.fit import Parameter
from noise_model.forward import Renderer

PAGE = "effects.md"
PICTURES = Path("figures") / "effects"
COLUMNS = 110
UNBROKEN = "\N{NO-BREAK SPACE}"

STAGES = {
    Stage.SOURCE: "the arc itself",
    Stage.ILLUMINATION: "the laser",
    Stage.SURFACE: "the metal",
    Stage.MEDIUM: "between part and camera",
    Stage.OPTICS: "window, lens and filter",
    Stage.SENSOR: "from charge to DN",
    Stage.GEOMETRY: "where things really are",
    Stage.TIMING: "when poses were really taken",
}

HONOURED = (
    (
        "`arctrack replay`, `arctrack explain`, `arctrack calibrate hand-eye`",
        "geometry, surface and sensor; what becomes of the arc's light; the poses' clock. What random "
        "effects scatter is no part of their noise: the tracker learns its stripe's from the frames",
    ),
    (
        "`arctrack simulate`",
        "all of them. Those of `--setup` are written with the recording; `--effect {id}.{value}`, once a "
        "parameter, adds one that the recording does not name",
    ),
    ("`arctrack plan`", "all but `interreflection`"),
    ("`arctrack diagnose`", "takes them for stated, and looks for others and for changes from there"),
    ("`arctrack inspect`", "lists them, and draws the stripe where they put it"),
    ("`noise_model.forward`", "`predict` gives mean and variance with them, `draw_frame` one frame"),
)

INTRO = """\
# Effects

What the nominal model leaves out. An effect has an id, a stage at which it acts, and parameters.
`noise_model.effects.REGISTRY` holds them all; `arctrack figures effects --out docs/reference` draws the
pictures and writes this page.

**The order of light.** Light goes through source, illumination, surface, medium, optics and sensor, in this
order; within a stage effects act in the order of the table below. Geometry and timing change what is
rendered.

**Naming one.** A table in `recording.toml` says that an effect is known to act:

```toml
[effects.{id}]
{values}
```

A parameter that the file leaves out takes its neutral value, which is where its prior starts. With all of
them neutral an effect does nothing. An unknown id or parameter is reported and has no effect. A value out of
its bounds is an error that names it. So is `interreflection` on a `u_groove`, where it is not followed.

**What uses them.** Everything that predicts light:

| | |
| --- | --- |
{honoured}

**The pictures** show each effect at the values that its section states. Frames are 640 × 480. Their
brightness is drawn by √, on one scale for both. Differences are in DN, red for brighter, blue for darker.
Where both frames are saturated there is no difference. Expected frames are free of noise. Random effects are
shown in single frames. The 1 σ that is predicted for each pixel stands beside them. Effects that move all
pixels at once are shown in one frame after another.
"""


def page(registry: Mapping[str, Effect]) -> str:
    """Return the page's text: intro, all ids by stage, a section for each effect."""
    effects = list(registry.values())
    first = effects[0]
    rows = "\n".join(f"| {who} | {what} |" for who, what in HONOURED)
    named = {"id": first.id, "value": _toml(first)[0].replace(" = ", "=")}
    intro = INTRO.format(values="\n".join(_toml(first)), honoured=rows.format(**named), **named)
    return "\n".join([intro, *_overview(effects), *(line for e in effects for line in _section(e))])


def write(folder: Path, registry: Mapping[str, Effect], on_picture: Callable[[Path], None]) -> None:
    """Write the page and its pictures to a folder, made if missing; `on_picture` hears of each when done."""
    pictures = folder / PICTURES
    pictures.mkdir(parents=True, exist_ok=True)
    renderer = Renderer()
    for effect in registry.values():
        path = pictures / f"{effect.id}.png"
        shown = effect_pictures.Shown.of(effect, renderer)
        effect_pictures.write(effect_pictures.draw(effect, shown), effect, path)
        on_picture(path)
    (folder / PAGE).write_text(page(registry), encoding="utf-8")


def _overview(effects: Iterable[Effect]) -> Iterator[str]:
    yield "| stage | effect | what it is |"
    yield "| --- | --- | --- |"
    above = None
    for effect in effects:
        stage = f"**{effect.stage.value}**, {STAGES[effect.stage]}" if effect.stage is not above else ""
        above = effect.stage
        yield f"| {stage} | [`{effect.id}`](#{effect.id}) | {_cell(effect.summary)} |"
    yield ""


def _section(effect: Effect) -> Iterator[str]:
    chosen = effect_pictures.choice(effect.id)
    yield f"## {effect.id}"
    yield ""
    yield from _wrapped(f"{effect.summary[:1].upper()}{effect.summary[1:]}.")
    yield ""
    yield from ("    " + line for line in textwrap.wrap(effect.equation, COLUMNS - 4))
    yield ""
    yield "| parameter | unit | neutral | prior 1 σ | bounds |"
    yield "| --- | --- | --- | --- | --- |"
    yield from (_row(parameter) for parameter in effect.parameters)
    yield ""
    if effect.needs:
        needed = " and ".join(f"`[{section}]`" for section in effect.needs)
        yield from _wrapped(f"Needs {needed}, which a setup may leave out.")
        yield ""
    yield from _wrapped(f"Source: {effect.source}.")
    yield ""
    values = ", ".join(f"`{value}`".replace(" ", UNBROKEN) for value in _toml(effect))
    yield from _wrapped(f"Shown: {values}; {chosen.scene}; {chosen.form.value}.")
    yield ""
    yield f"![{effect.id}: {effect.summary}]({(PICTURES / effect.id).as_posix()}.png)"
    yield ""


def _row(parameter: Parameter) -> str:
    bounds = f"{_number(parameter.lower)} to {_number(parameter.upper)}"
    unit = parameter.unit or "–"
    start, sigma = _number(parameter.start), _number(parameter.prior_sigma)
    return f"| `{parameter.name}` | {unit} | {start} | {sigma} | {bounds} |"


def _toml(effect: Effect) -> list[str]:
    return [f"{name} = {float(value)!r}" for name, value in effect.typical.items()]


def _number(value: float) -> str:
    return f"{value:.12g}".replace("-", "−").replace("inf", "∞")


def _cell(text: str) -> str:
    """Keep a text within its cell of a table."""
    return text.replace("|", "\\|")


def _wrapped(text: str) -> list[str]:
    lines = textwrap.wrap(text, COLUMNS, break_long_words=False, break_on_hyphens=False)
    return [line.replace(UNBROKEN, " ") for line in lines]
