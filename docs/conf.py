"""How Sphinx builds the documentation, without network: `sphinx-build -W docs SITE`."""

from __future__ import annotations

import importlib.metadata

project = "arctrack"
version = release = importlib.metadata.version("arctrack")
html_title = f"arctrack {version}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
myst_heading_anchors = 4

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
# A default by its name: its value would fill lines.
autodoc_preserve_defaults = True
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_show_sourcelink = False
html_theme_options = {
    "navigation_with_keys": False,
    "footer_start": [],
    "footer_end": [],
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
}
