"""Blender for tests: `bpy` from PyPI in a separate environment, because it pins numpy; tests skip without it."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest


def inspect_in_blender(glb: Path, picture: Path, seconds: float) -> dict[str, Any]:
    """Import a .glb in Blender at a time of its animation and return what was found; also render `picture`.

    BLENDER_PYTHON names the Python that can `import bpy` (`python3.11 -m venv DIR && DIR/bin/pip install bpy`).
    """
    python = os.environ.get("BLENDER_PYTHON", "")
    if not Path(python).is_file():
        pytest.skip("BLENDER_PYTHON does not name a Python with bpy")
    script = Path(__file__).with_name("blender_import.py")
    command = [python, script, glb, picture, str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    found = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert found, done.stderr[-2000:]
    return json.loads(found[0].removeprefix("RESULT "))
