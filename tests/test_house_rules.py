"""Rules of the house that no linter knows: small files and functions, declared dependencies, whole configuration."""

import ast
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

PACKAGES = ("pipeline", "stages", "data_tools")
FILE_LINES = 400
FUNCTION_LINES = 80


def sources(repository: Path) -> Iterator[Path]:
    for package in (*PACKAGES, "tests"):
        yield from (repository / package).rglob("*.py")


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def third_party(tree: ast.AST) -> set[str]:
    """Top-level names of the modules that a file imports and that are neither ours nor Python's."""
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
        name = path.relative_to(repository)
        if text.count("\n") > FILE_LINES:
            too_long.append(f"{name}: {text.count(chr(10))} lines")
        for node in functions(ast.parse(text)):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > FUNCTION_LINES:
                too_long.append(f"{name}: {node.name} has {lines} lines")
    assert not too_long


def test_compiled_functions_are_found_in_the_cache(repository: Path) -> None:
    """A compiled closure that calls another one has a new key in numba's cache in every process: seconds each time."""
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
    declared = {normal(line) for line in project["dependencies"]}
    owners = packages_distributions()
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


@pytest.mark.parametrize("line", ["Torch==2.4+cpu", "torch>=2,<3", "torch"])
def test_package_names_are_read_from_requirements(line: str) -> None:
    assert normal(line) == "torch"


def normal(requirement: str) -> str:
    """The normalised package name of a requirement line."""
    for separator in "=<>!~;[ ":
        requirement = requirement.split(separator)[0]
    return requirement.strip().lower().replace("_", "-").replace(".", "-")
