"""Results for programs as JSON; docs/reference/json_output.md names the keys of those on stdout."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


def say_json(command: str, content: Mapping[str, Any]) -> None:
    """Print the result of a command."""
    print(json_text({"format": f"arctrack-{command}/1", **content}), flush=True)


def json_text(content: Mapping[str, Any]) -> str:
    """Return a result as JSON; a number that is not known is null."""
    return json.dumps(_plain(content), allow_nan=False, indent=1)


def _plain(value: Any) -> Any:
    match value:
        case float():
            return float(value) if math.isfinite(value) else None
        case Mapping():
            return {key: _plain(each) for key, each in value.items()}
        case list() | tuple():
            return [_plain(each) for each in value]
        case Path():
            return str(value)
    return value
