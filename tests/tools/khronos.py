"""The Khronos glTF validator (npm package gltf-validator) for tests; tests skip if it is not installed."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

REPOSITORY_DIR = Path(__file__).resolve().parents[2]
WARNING = 1  # severities: 0 error, 1 warning, 2 information, 3 hint


def validator_issues(path: Path) -> list[dict[str, Any]]:
    """Return the errors and warnings of the validator for a file.

    The package is searched in GLTF_VALIDATOR_MODULES and in the repository's node_modules (`make gltf-validator`).
    """
    node = shutil.which("node")
    folders = [Path(os.environ.get("GLTF_VALIDATOR_MODULES", "")), REPOSITORY_DIR / "node_modules"]
    modules = next((folder for folder in folders if (folder / "gltf-validator").is_dir()), None)
    if node is None or modules is None:
        pytest.skip("the Khronos validator is not installed: `make gltf-validator` (needs node)")
    script = Path(__file__).with_name("validate_gltf.js")
    environment = os.environ | {"NODE_PATH": str(modules.resolve())}
    done = subprocess.run(
        [node, script, path], env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    if done.returncode != 0:
        return [{"severity": 0, "message": done.stderr.strip()}]
    return [issue for issue in json.loads(done.stdout)["issues"]["messages"] if issue["severity"] <= WARNING]
