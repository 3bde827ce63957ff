"""How Sphinx builds the documentation, without network: `sphinx-build -W docs SITE`."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import inspect
from enum import Enum
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import stringify_signature

project = "arctrack"
version = release = importlib.metadata.version("arctrack")
html_title = f"arctrack {version}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "sphinx_copybutton"]
myst_heading_anchors = 4

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_preserve_defaults = True
numpydoc_show_class_members = False

# Of a console block the commands alone are copied.
copybutton_prompt_text = "$ "
copybutton_line_continuation_character = "\\"

html_theme = "pydata_sphinx_theme"
html_show_sourcelink = False
# Without it the theme's script reports an invalid mode on each page.
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navigation_with_keys": False,
    "footer_start": [],
    "footer_end": [],
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
}


class _Elided:
    """A default whose value would fill lines."""

    def __repr__(self) -> str:
        return "…"


def _is_short(default: Any) -> bool:
    if type(default) is tuple:
        return all(map(_is_short, default))
    return default is None or isinstance(default, bool | int | float | str | Enum)


def _elide_defaults(
    _app: Sphinx, _what: str, _name: str, described: Any, _options: Any, stated: str | None, _result: Any
) -> tuple[str, None] | None:
    """Return a data class's signature: Sphinx would print the values of defaults that are arrays or objects.

    A page states "()" for what arctrack alone makes.
    """
    if stated == "()" or not (inspect.isclass(described) and dataclasses.is_dataclass(described)):
        return None
    signature = inspect.signature(described)
    shown = [
        each if each.default is each.empty or _is_short(each.default) else each.replace(default=_Elided())
        for each in signature.parameters.values()
    ]
    return stringify_signature(signature.replace(parameters=shown), show_annotation=False), None


def _list_stated_fields(
    _app: Sphinx, _what: str, _name: str, described: Any, _options: Any, lines: list[str]
) -> None:
    """Add a list of a data class's fields whose metadata states role, unit and source."""
    fields = dataclasses.fields(described) if dataclasses.is_dataclass(described) else ()
    stated = [(field.name, field.metadata) for field in fields if "role" in field.metadata]
    if stated:
        lines.append("")
    for name, said in stated:
        lines.append(
            f"- ``{name}``: {', '.join(filter(None, (said['role'], said['unit'])))} ({said['source']})"
        )
    if stated:
        lines.append("")


def setup(app: Sphinx) -> None:
    """Shorten the signatures of data classes, and list what their fields' metadata states."""
    app.connect("autodoc-process-signature", _elide_defaults)
    app.connect("autodoc-process-docstring", _list_stated_fields)
