"""What the documents say is so: packages and ranges, system libraries, commands, links, files of each stage."""

import re
import tomllib
from pathlib import Path

import pytest

from scripts.doctor import SYSTEM_LIBRARIES
from stages import STAGES, load_stage


@pytest.fixture(scope="module")
def readme() -> str:
    return (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def table_rows(text: str) -> list[list[str]]:
    """Cells of all table lines, headings left out."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not line.startswith("|---")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def split_requirement(requirement: str) -> tuple[str, str]:
    found = re.match(r"([A-Za-z0-9_.-]+)\s*(.*)", requirement)
    assert found
    return found.group(1), found.group(2)


def test_the_dependency_table_is_that_of_the_project(repository: Path):
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = table_rows((repository / "docs/dependencies.md").read_text(encoding="utf-8"))[1:]
    assert {(name, span) for name, span, *_ in rows} == {split_requirement(line) for line in project["dependencies"]}
    assert all(licence and reason for _, _, licence, reason in rows)


def test_development_packages_are_named(repository: Path):
    extras = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (repository / "docs/dependencies.md").read_text(encoding="utf-8")
    names = [split_requirement(line)[0] for extra in extras["optional-dependencies"].values() for line in extra]
    assert [name for name in names if not re.search(rf"\b{re.escape(name)}\b", text)] == []


def test_the_readme_names_every_system_library(readme: str):
    command = re.search(r"apt-get install (.+?)\n\n", readme, re.DOTALL)
    assert command
    assert set(SYSTEM_LIBRARIES.values()) <= set(command.group(1).replace("\\", " ").split())


def test_make_targets_in_the_readme_exist(readme: str, repository: Path):
    makefile = (repository / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^(\w+):", makefile, re.MULTILINE)) | set(STAGES)
    used = set(re.findall(r"(?:^    |`)make (\w+)", readme, re.MULTILINE))
    assert used
    assert used <= targets


def test_files_of_the_stages_are_those_that_the_documents_name(repository: Path):
    text = (repository / "docs/how-it-works.md").read_text(encoding="utf-8")
    rows = {row[0].strip("`/"): row[1] for row in table_rows(text)[1:]}
    assert list(rows) == list(STAGES)
    for name in STAGES:
        made = set(load_stage(name).makes)
        named = {word.rstrip("/") for word in re.findall(r"`([^`]+)`", rows[name])}
        assert named <= made | {"images", "masks"}, name


def test_the_readme_is_short(readme: str):
    assert len(readme.split()) < 1000


def test_local_links_lead_somewhere(readme: str, repository: Path):
    texts = [(repository, readme)]
    texts += [(path.parent, path.read_text(encoding="utf-8")) for path in (repository / "docs").rglob("*.md")]
    missing = []
    for folder, text in texts:
        missing += [
            path
            for path in re.findall(r"`((?:pipeline|stages|docs|configs|data_tools|scripts)/[\w./-]+)`", text)
            if not (repository / path).exists()
        ]
        links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if not link.startswith("http")]
        missing += [link for link in links if not (folder / link).exists()]
    assert missing == []


def test_options_in_the_readme_are_known(readme: str):
    used = set(re.findall(rf"\b((?:{'|'.join(STAGES)})\.\w+)=", readme))
    assert used
    for key in used:
        stage, _, name = key.partition(".")
        assert name in load_stage(stage).config.model_fields
