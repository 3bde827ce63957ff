"""Rendering of all pages' templates."""

from jinja2 import Environment, PackageLoader, StrictUndefined


def environment() -> Environment:
    """Return an environment for `templates/`: text is escaped, and a name that means nothing is an error."""
    return Environment(
        loader=PackageLoader("arctrack.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
