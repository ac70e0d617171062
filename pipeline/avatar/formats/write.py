"""The files that are made of the finished .glb on request: VRM, levels of detail, USDZ, a compressed .glb."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from pipeline.avatar.formats.levels_of_detail import encode_levels
from pipeline.avatar.formats.usdz import write_usdz
from pipeline.avatar.formats.vrm import NOTHING_LOOSE, VrmMeta, encode_vrm0, encode_vrm1
from pipeline.avatar.formats.vrm_springs import LooseParts
from pipeline.avatar.formats.web_glb import encode_web_glb
from pipeline.io.glb import GlbFile

ExportFormat = Literal["lod", "usdz", "vrm", "vrm0", "web"]

PACKAGES: dict[ExportFormat, tuple[str, str]] = {"usdz": ("pxr", "usd-core"), "web": ("DracoPy", "DracoPy")}
"""Module and package that a format needs; the extra of pyproject.toml has the name of the format."""


@dataclass(frozen=True)
class FormatRequest:
    """What is made of the .glb.

    joint_names: Mixamo's names of the skin's joints, in its order. meta: of the VRM files. loose: skirts and hair, for
    the spring bones of the VRM files.
    """

    formats: Sequence[ExportFormat]
    joint_names: Sequence[str]
    meta: VrmMeta
    loose: LooseParts = NOTHING_LOOSE


def missing_package(formats: Sequence[ExportFormat]) -> str | None:
    """Return which package to install, as a part of a sentence; None if the formats need no other one."""
    for name in formats:
        module, package = PACKAGES.get(name, ("", ""))
        if module and find_spec(module) is None:
            return f"without {name} until {package} is installed: make venv EXTRA={name}, or pip install {package}"
    return None


def write_formats(glb_path: Path, request: FormatRequest) -> None:
    """Write the requested files next to the .glb, with its name: avatar.vrm, avatar_lod1.glb, avatar_web.glb, ...

    Raises:
        UserError: the .glb cannot be read.
        ModuleNotFoundError: a format needs a package that is not installed (`missing_package`).
    """
    file, vrm = GlbFile(glb_path), (request.joint_names, request.meta, request.loose)
    writers: dict[ExportFormat, Callable[[], None]] = {
        "lod": lambda: _write_levels(glb_path, file),
        "usdz": lambda: write_usdz(glb_path.with_suffix(".usdz"), file),
        "vrm": lambda: _write(glb_path.with_suffix(".vrm"), encode_vrm1(file, *vrm)),
        "vrm0": lambda: _write(glb_path.with_name(f"{glb_path.stem}_vrm0.vrm"), encode_vrm0(file, *vrm)),
        "web": lambda: _write(glb_path.with_name(f"{glb_path.stem}_web.glb"), encode_web_glb(file)),
    }
    for name in request.formats:
        writers[name]()


def _write_levels(glb_path: Path, file: GlbFile) -> None:
    for level, data in enumerate(encode_levels(file), 1):
        _write(glb_path.with_name(f"{glb_path.stem}_lod{level}.glb"), data)


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
