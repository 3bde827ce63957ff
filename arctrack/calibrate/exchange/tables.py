"""Tables of a calibration's text: YAML, OpenCV's YAML and XML, a Python dict, HALCON's groups."""

import ast
import re
from collections.abc import Mapping
from typing import Any

import cv2
import yaml

from arctrack.recording.files import UnfitFileError

OPENCV_HEADS = ("%YAML", "<?xml", "<opencv_storage")
HALCON_PARAMETER = re.compile(r"^[ \t]*(\w+)[ \t]*:[ \t]*[A-Za-z]\w*[ \t]*:([^;\n]*);", re.MULTILINE)
"""First line of a parameter: name, short name, value. Those of its type and meaning have no short name."""


def tables_of(text: str) -> Mapping[str, Any]:
    """Return the keys of a file's text, with tables as mappings; UnfitFileError for another content."""
    begin = text.lstrip()
    if begin.startswith(OPENCV_HEADS):
        return _opencv(begin)
    if "ParGroup" in text:
        return {name: value.strip().strip('"') for name, value in HALCON_PARAMETER.findall(text)}
    is_dict = re.match(r"(\s*#.*\n|\s*\n)*\s*\{", text) is not None
    content = _python_dict(text) if is_dict else _yaml(text)
    if not isinstance(content, Mapping):
        raise UnfitFileError("holds no keys of a camera")
    return {str(key): value for key, value in content.items()}


def _python_dict(text: str) -> object:
    # ast.literal_eval knows numbers, texts and lists alone, and calls nothing.
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return _yaml(text)


def _yaml(text: str) -> object:
    """Return the first document: a log of a topic has one for each message."""
    try:
        return next(yaml.safe_load_all(text), None)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = None if mark is None else mark.line + 1
        raise UnfitFileError(f"is no YAML: {error.problem or error.context}", line) from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise UnfitFileError("is no YAML") from None


def _opencv(text: str) -> Mapping[str, Any]:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        content = _content(storage.root())
    except (cv2.error, SystemError):
        raise UnfitFileError("is no valid file of OpenCV's") from None
    return content if isinstance(content, Mapping) else {}


def _content(node: Any) -> object:
    if node.isMap():
        return {name: _content(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_content(node.at(n)) for n in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None
