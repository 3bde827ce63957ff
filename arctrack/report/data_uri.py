"""Files that lie within a page."""

import base64


def uri(kind: str, content: bytes) -> str:
    """Return a file's content as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
