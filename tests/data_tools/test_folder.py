"""Output folders are created atomically."""

import pytest

from data_tools.folder import atomic_folder, replaced_folder, require_absent, result_folder
from pipeline.core.errors import UserError


def test_folder_appears_when_the_block_ends(tmp_path):
    with atomic_folder(tmp_path / "a" / "out") as part:
        (part / "x").write_text("1")
        assert not (tmp_path / "a" / "out").exists()
    assert (tmp_path / "a" / "out" / "x").read_text() == "1"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["out"]


def test_failed_block_leaves_no_folder_and_no_remains(tmp_path):
    def half() -> None:
        with atomic_folder(tmp_path / "out") as part:
            (part / "old").write_text("1")
            raise ValueError("half")

    with pytest.raises(ValueError, match="half"):
        half()
    assert not (tmp_path / "out").exists()
    with atomic_folder(tmp_path / "out") as part:
        assert not any(part.iterdir())


def test_existing_paths_are_errors(tmp_path):
    (tmp_path / "out").write_text("precious")
    with pytest.raises(UserError, match="already exists"), atomic_folder(tmp_path / "out"):
        pass
    with pytest.raises(UserError, match="already exists"):
        require_absent(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "precious"


def write_result(out, **files):
    with result_folder(out) as part:
        for name, text in files.items():
            (part / name).write_text(text)


def contents(out):
    return {path.name: path.read_text() for path in out.iterdir() if not path.name.startswith(".")}


def test_a_users_files_stay_and_those_of_the_earlier_result_go(tmp_path):
    out = tmp_path / "shirt"
    write_result(out, avatar="1", diffuse="1", only_before="1")
    (out / "shirt.xcf").write_text("layers")
    (out / "sketches").symlink_to(tmp_path)
    write_result(out, avatar="2", diffuse="2")
    assert (out / "sketches").is_symlink()
    (out / "sketches").unlink()
    assert contents(out) == {"avatar": "2", "diffuse": "2", "shirt.xcf": "layers"}
    assert [path.name for path in tmp_path.iterdir()] == ["shirt"]


@pytest.mark.parametrize(("name", "text"), [("diffuse", "painted"), ("preview", "mine")])
def test_a_file_of_the_user_is_not_replaced(tmp_path, name, text):
    out = tmp_path / "shirt"
    write_result(out, avatar="1", diffuse="1")
    (out / name).write_text(text)
    with pytest.raises(UserError, match=f"shirt/{name} was edited .* --name"):
        write_result(out, avatar="2", diffuse="2", preview="2")
    assert contents(out) == {"avatar": "1", "diffuse": "1"} | {name: text}


def test_a_kill_during_the_replacement_loses_nothing_of_the_user(tmp_path):
    out, replaced = tmp_path / "shirt", tmp_path / "shirt.replaced"
    write_result(out, avatar="1")
    (out / "mine").write_text("layers")
    out.rename(replaced)
    write_result(out, avatar="2")
    assert contents(out) == {"avatar": "2", "mine": "layers"}
    out.rename(replaced)
    with replaced_folder(tmp_path / "new") as part:
        (part / "avatar").write_text("3")
    (tmp_path / "new").rename(out)
    write_result(out, avatar="4")
    assert contents(out) == {"avatar": "4", "mine": "layers"}
    assert not replaced.exists()
