"""Results for programs: one JSON object on stdout; docs/reference/json_output.md names its keys."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


def say_json(command: str, content: Mapping[str, Any]) -> None:
    """Print the result of a command; a number that is not known is null."""
    whole = {"format": f"arctrack-{command}/1", **content}
    print(json.dumps(_plain(whole), allow_nan=False, indent=1), flush=True)


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
