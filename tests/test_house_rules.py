"""Rules that no linter checks: size of files, functions and packages, parameters, declared dependencies."""

import ast
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

PACKAGES = ("pipeline", "stages", "data_tools")
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 80
MAX_PARAMETERS = 8
MAX_MODULES = 20

MODULES_OF_EXTRAS = {"cuda": ["cuda-core"], "pxr": ["usd-core"]}
"""Modules of extras whose name is not that of their package; it is not known where the package is not installed."""

# Offenders that remain; no entry may be added.
ALLOWED_PARAMETERS = {
    "pipeline/kernels/broyden/cpu.py",
    "pipeline/kernels/composite/cpu.py",
    "pipeline/kernels/inverse_skinning/cell_skinning_cpu.py",
    "pipeline/kernels/inverse_skinning/cpu.py",
    "pipeline/kernels/inverse_skinning/newton_cpu.py",
    "pipeline/kernels/kinematics/cpu.py",
    "pipeline/kernels/march/__init__.py",
    "pipeline/kernels/march/cpu.py",
    "pipeline/kernels/march/reference.py",
    "pipeline/kernels/march/reference_stops.py",
    "pipeline/kernels/pixel_sampling/__init__.py",
    "pipeline/kernels/pixel_sampling/cpu.py",
    "pipeline/kernels/pixel_sampling/reference.py",
    "pipeline/kernels/ray_losses/cpu.py",
    "pipeline/kernels/texel_projection/__init__.py",
    "pipeline/kernels/texel_projection/cpu.py",
    "pipeline/kernels/texel_projection/reference.py",
    "pipeline/kernels/volume_rendering/__init__.py",
    "pipeline/kernels/volume_rendering/backward_cpu.py",
    "pipeline/kernels/volume_rendering/cpu.py",
}


def sources(repository: Path) -> Iterator[Path]:
    for package in (*PACKAGES, "tests"):
        yield from (repository / package).rglob("*.py")


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def public_functions(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Functions and methods whose names, and whose classes' names, have no leading underscore."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node)


def count_parameters(function: ast.FunctionDef) -> int:
    arguments = function.args
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def third_party(tree: ast.AST) -> set[str]:
    """Top-level names of the modules that a file imports from other projects, without the standard library."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return names - set(sys.stdlib_module_names) - {*PACKAGES, "tests"}


def test_files_and_functions_stay_small(repository: Path) -> None:
    too_long = []
    for path in sources(repository):
        text = path.read_text(encoding="utf-8")
        name = path.relative_to(repository).as_posix()
        if text.count("\n") > MAX_FILE_LINES:
            too_long.append(f"{name}: {text.count(chr(10))} lines")
        for node in functions(ast.parse(text)):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > MAX_FUNCTION_LINES:
                too_long.append(f"{name}: {node.name} has {lines} lines")
    assert not too_long


def test_public_functions_have_few_parameters(repository: Path) -> None:
    offenders = [
        f"{path.relative_to(repository)}: {function.name} has {count_parameters(function)}"
        for package in PACKAGES
        for path in (repository / package).rglob("*.py")
        if path.relative_to(repository).as_posix() not in ALLOWED_PARAMETERS
        for function in public_functions(ast.parse(path.read_text(encoding="utf-8")))
        if count_parameters(function) > MAX_PARAMETERS
    ]
    assert not offenders


def test_packages_have_few_modules(repository: Path) -> None:
    files = (path for package in PACKAGES for path in (repository / package).rglob("*.py"))
    modules = Counter(path.parent.relative_to(repository) for path in files if path.stem != "__init__")
    assert {folder.as_posix(): count for folder, count in modules.items() if count > MAX_MODULES} == {}


def test_parameters_are_counted_without_self() -> None:
    tree = ast.parse("class A:\n  def f(self, a, /, b, *, c): ...\n  def _g(self): ...\ndef h(): ...\n")
    assert [(node.name, count_parameters(node)) for node in public_functions(tree)] == [("f", 3), ("h", 0)]


def test_compiled_functions_are_found_in_the_cache(repository: Path) -> None:
    """A compiled closure that calls another one gets a new key in numba's cache in every process: seconds each time."""
    closures = [
        f"{path.name}: {inner.name} in {outer.name}"
        for path in (repository / "pipeline" / "kernels").glob("*/*cpu.py")
        for outer in functions(ast.parse(path.read_text(encoding="utf-8")))
        for inner in functions(outer)
        if inner is not outer
    ]
    assert not closures


def test_every_import_is_a_declared_dependency(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    optional = [line for extra, lines in project["optional-dependencies"].items() if extra != "dev" for line in lines]
    declared = {normal(line) for line in project["dependencies"] + optional}
    owners = MODULES_OF_EXTRAS | packages_distributions()
    undeclared = {
        f"{path.relative_to(repository)}: {module}"
        for package in PACKAGES
        for path in (repository / package).rglob("*.py")
        for module in third_party(ast.parse(path.read_text(encoding="utf-8")))
        if not declared & {normal(owner) for owner in owners.get(module, [module])}
    }
    assert not undeclared


def test_every_declared_dependency_is_locked(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    locked = {normal(line) for line in (repository / "requirements.lock").read_text().splitlines()}
    wanted = {normal(line) for line in project["dependencies"] + project["optional-dependencies"]["dev"]}
    assert wanted <= locked


def test_importing_the_stages_imports_no_slow_library(repository: Path) -> None:
    """A second or more for each command: torch's compiler (which roma imports), the detector, the body model."""
    slow = "torch._dynamo", "sympy", "mediapipe", "jax", "anny", "warp", "pymeshlab", "matplotlib"
    assert imported_by("import stages; stages.PIPELINE.load_stages()", slow, repository) == "[]"


def test_reading_the_template_imports_neither_the_body_model_nor_a_compiler(repository: Path) -> None:
    """Mesh, texture and export read its parts, sum in a fixed order, and would wait for each import."""
    code = """
from pipeline.kernels.common.determinism import deterministic_sums
from pipeline.template.face.units import load_face_units, load_teeth
from pipeline.template.layout import load_layout
from pipeline.template.regions import load_template
with deterministic_sums():
    load_template(), load_layout(), load_face_units(), load_teeth()
"""
    assert imported_by(code, ("torch._dynamo", "sympy", "anny", "roma"), repository) == "[]"


def imported_by(code: str, modules: tuple[str, ...], repository: Path) -> str:
    """Run code in an interpreter; return the list of those modules that are imported then."""
    code += f"\nimport sys; print([m for m in {modules} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.mark.parametrize("line", ["Torch==2.4+cpu", "torch>=2,<3", "torch"])
def test_package_names_are_read_from_requirements(line: str) -> None:
    assert normal(line) == "torch"


def normal(requirement: str) -> str:
    """The normalised package name of a requirement line."""
    for separator in "=<>!~;[ ":
        requirement = requirement.split(separator)[0]
    return requirement.strip().lower().replace("_", "-").replace(".", "-")
