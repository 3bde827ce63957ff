"""docs/reference/effects.md, made from the registry of effects: what each does, in words and a picture."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path

from noise_model.effects import Effect, Stage
from noise_model.fit import Parameter
from noise_model.forward import Renderer
from validation.figures import effect_pictures

PAGE = "effects.md"
PICTURES = Path("figures") / "effects"
COLUMNS = 110

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
        "geometry, surface, sensor, the arc's light, the poses' clock; not the scatter of random effects",
    ),
    ("`arctrack simulate`", "all; `--effect {id}.{value}` adds one"),
    ("`arctrack plan`", "all but `interreflection`"),
    ("`arctrack diagnose`", "all, as stated; it looks for others and for changes from there"),
    ("`arctrack inspect`", "lists them, and draws the stripe where they put it"),
    ("`noise_model.forward`", "all: `predict` gives mean and variance, `draw_frame` one frame"),
)

INTRO = """\
# Effects

What the nominal model leaves out, and how `recording.toml` states it. From `noise_model.effects.REGISTRY`
`python -m validation.figures effects --out docs/reference` writes this page and its pictures.

A table of the setup says that an effect is known to act:

```toml
[effects.{id}]
{values}
```

A parameter stands with its bounds, its neutral value and its prior's 1 σ. One that is left out is neutral.
With all of them neutral an effect does nothing. An unknown id or parameter is reported and ignored. A value
out of its bounds is an error, and so is `interreflection` on a `u_groove`.

| command | uses |
| --- | --- |
{honoured}

Light goes through source, illumination, surface, medium, optics and sensor, and through the effects of a
stage in the order of this table. Geometry and timing change what is rendered.

{overview}

In the pictures' differences red is brighter, blue is darker.
"""


def page(registry: Mapping[str, Effect]) -> str:
    """Return the page's text: intro with all ids by stage, a section for each effect."""
    effects = list(registry.values())
    first = effects[0]
    rows = "\n".join(f"| {who} | {what} |" for who, what in HONOURED)
    named = {"id": first.id, "value": _toml(first)[0].replace(" = ", "=")}
    intro = INTRO.format(
        values="\n".join(_toml(first)),
        honoured=rows.format(**named),
        overview="\n".join(_overview(effects)),
        **named,
    )
    return "\n".join([intro, *(line for effect in effects for line in _section(effect))])


def write(folder: Path, registry: Mapping[str, Effect], on_picture: Callable[[Path], None]) -> None:
    """Write the page and its pictures to a folder, made if missing; `on_picture` hears of each when done."""
    pictures = folder / PICTURES
    pictures.mkdir(parents=True, exist_ok=True)
    renderer = Renderer()
    for effect in registry.values():
        path = pictures / f"{effect.id}.png"
        shown = effect_pictures.EffectScene.of(effect, renderer)
        effect_pictures.write(effect_pictures.draw(effect, shown), effect, path)
        on_picture(path)
    (folder / PAGE).write_text(page(registry), encoding="utf-8")


def _overview(effects: Iterable[Effect]) -> Iterator[str]:
    yield "| stage | effects |"
    yield "| --- | --- |"
    for stage, group in groupby(effects, key=lambda effect: effect.stage):
        links = ", ".join(f"[`{effect.id}`](#{effect.id})" for effect in group)
        yield f"| **{stage.value}**, {STAGES[stage]} | {links} |"


def _section(effect: Effect) -> Iterator[str]:
    yield f"## {effect.id}"
    yield ""
    yield from _wrapped(f"{effect.summary[:1].upper()}{effect.summary[1:]}.")
    yield ""
    yield from ("    " + line for line in textwrap.wrap(effect.equation, COLUMNS - 4))
    yield ""
    yield from (_item(parameter) for parameter in effect.parameters)
    yield ""
    if effect.needs:
        needed = " and ".join(f"`[{section}]`" for section in effect.needs)
        yield f"Needs {needed}."
        yield ""
    yield from _wrapped(f"Source: {effect.source}.")
    yield ""
    yield f"![Frames with {effect.id}]({(PICTURES / effect.id).as_posix()}.png)"
    yield ""


def _item(parameter: Parameter) -> str:
    bounds = f"{_number(parameter.lower)} to {_number(parameter.upper)} {parameter.unit}".rstrip()
    start, sigma = _number(parameter.start), _number(parameter.prior_sigma)
    return f"- `{parameter.name}`: {bounds}; {start} ± {sigma}"


def _toml(effect: Effect) -> list[str]:
    return [f"{name} = {float(value)!r}" for name, value in effect.typical.items()]


def _number(value: float) -> str:
    return f"{value:.12g}".replace("-", "−").replace("inf", "∞")


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, COLUMNS, break_long_words=False, break_on_hyphens=False)
