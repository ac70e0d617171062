"""Read JSON that the program did not write: bounded in size and depth, and wrong only in one way."""

import json
from pathlib import Path
from typing import Any

MAX_JSON_BYTES = 64 << 20
"""Larger documents are refused; the JSON of a glTF file with 100,000 nodes has 20 MB."""


def load_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        OSError: the file cannot be opened.
        ValueError: it is no JSON text, too large or nested too deeply.
    """
    size = path.stat().st_size
    if size > MAX_JSON_BYTES:
        raise ValueError(f"{size} bytes, at most {MAX_JSON_BYTES} are read")
    return parse_json(path.read_bytes())


def parse_json(text: bytes) -> Any:
    """Parse UTF-8 text as JSON. ValueError if it is no JSON, too large or nested too deeply."""
    if len(text) > MAX_JSON_BYTES:
        raise ValueError(f"{len(text)} bytes of JSON, at most {MAX_JSON_BYTES} are read")
    try:
        return json.loads(text.decode("utf-8"))
    except RecursionError:
        raise ValueError("its lists are nested too deeply") from None
