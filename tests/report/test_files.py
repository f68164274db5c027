"""What an output directory may and may not do to what is in it."""

import json
from pathlib import Path

import pytest

from fmu.report.files import MANIFEST, OutputDirectory


def publish(root, **files):
    write(OutputDirectory(root), **files)


def write(directory, **files):
    """Write files, a double underscore standing for a slash."""
    with directory.stage_files() as stage:
        for name, text in files.items():
            path = stage / name.replace("__", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


def tree(root):
    return {p.relative_to(root).as_posix(): p.read_text() for p in root.rglob("*") if p.is_file()}


def listed(root):
    return json.loads((root / MANIFEST).read_text())["files"]


def test_files_appear_with_a_manifest(tmp_path):
    root = tmp_path / "a" / "out"
    publish(root, one="1", sub__two="2")
    assert {name: text for name, text in tree(root).items() if name != MANIFEST} == {"one": "1", "sub/two": "2"}
    assert listed(root) == ["one", "sub/two"]


def test_the_committed_results_are_known_to_be_ours(tmp_path):
    """As is every directory that an earlier version has written."""
    kept = Path(__file__).parents[2] / "results" / MANIFEST
    names = json.loads(kept.read_text())["files"]
    for name in (MANIFEST, *names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(kept.read_text() if name == MANIFEST else "old")
    publish(tmp_path, one="1")
    assert sorted(tree(tmp_path)) == [MANIFEST, "one"]


def test_own_files_are_replaced_and_outdated_ones_taken_away(tmp_path):
    publish(tmp_path, one="1", two="2")
    publish(tmp_path, one="new", three="3")
    assert {name: text for name, text in tree(tmp_path).items() if name != MANIFEST} == {
        "one": "new",
        "three": "3",
    }
    assert listed(tmp_path) == ["one", "three"]


def test_other_files_are_left_alone(tmp_path):
    publish(tmp_path, sub__one="1")
    (tmp_path / "notes").write_text("mine")
    (tmp_path / "sub" / "notes").write_text("mine too")
    publish(tmp_path, two="2")
    assert tree(tmp_path).keys() == {"notes", "sub/notes", "two", MANIFEST}
    assert (tmp_path / "notes").read_text() == "mine"


@pytest.mark.parametrize("known", [False, True])
def test_a_foreign_file_is_never_replaced(tmp_path, known):
    if known:
        publish(tmp_path, other="2")
    (tmp_path / "one").write_text("mine")
    with pytest.raises(ValueError, match=r"^out: .* holds 1 files that this command did not write .*\(one\)"):
        OutputDirectory(tmp_path).check(["one", "two"])
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="did not write"):
        publish(tmp_path, one="1", two="2")
    assert tree(tmp_path) == before


def test_a_file_where_a_directory_shall_be_is_never_replaced(tmp_path):
    (tmp_path / "sub").write_text("mine")
    with pytest.raises(ValueError, match="did not write"):
        OutputDirectory(tmp_path).check(["sub/deep/one"])
    with pytest.raises(ValueError, match="did not write"):
        publish(tmp_path, sub__deep__one="1")
    assert tree(tmp_path) == {"sub": "mine"}


def test_a_link_is_replaced_not_followed(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    root = tmp_path / "out"
    publish(root, one="1")
    (root / "one").unlink()
    (root / "one").symlink_to(outside)
    publish(root, one="2")
    assert outside.read_text() == "mine"
    assert (root / "one").read_text() == "2"


def test_an_error_publishes_nothing(tmp_path):
    publish(tmp_path, one="1")
    before = tree(tmp_path)
    with pytest.raises(FileExistsError):
        publish(tmp_path, a_one="half", a_one__two="2")
    assert tree(tmp_path) == before


def test_an_error_leaves_no_directory_that_was_not_there(tmp_path):
    with pytest.raises(RuntimeError), OutputDirectory(tmp_path / "a" / "b").stage_files():
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_what_is_being_written_is_known_to_be_ours_if_it_stops_halfway(tmp_path, monkeypatch):
    publish(tmp_path, one="1")
    directory = OutputDirectory(tmp_path)
    written = []
    monkeypatch.setattr(type(tmp_path), "replace", _fails_at("two", written))
    with pytest.raises(OSError, match="disk"):
        write(directory, one="new", two="2")
    monkeypatch.undo()
    assert (tmp_path / "one").read_text() == "new"
    assert {"one", "two"} <= set(listed(tmp_path))
    publish(tmp_path, one="again", two="2")
    assert (tmp_path / "one").read_text() == "again"


def _fails_at(name, written):
    import os
    from pathlib import Path

    def replace(self, target):
        if Path(target).name == name:
            raise OSError("disk full")
        written.append(target)
        os.replace(self, target)

    return replace


@pytest.mark.parametrize(
    "content", ["", "{}", '{"files": ["x"]}', '{"about": "somebody else", "files": []}', "[1]"]
)
def test_a_manifest_of_other_origin_stops_everything(tmp_path, content):
    (tmp_path / MANIFEST).write_text(content)
    with pytest.raises(ValueError, match=r"^out: .* is not a manifest written by fmu"):
        OutputDirectory(tmp_path)


@pytest.mark.parametrize("name", ["../escape", "/absolute", "sub/../../escape", MANIFEST, ""])
def test_names_must_stay_below_the_directory(tmp_path, name):
    publish(tmp_path, one="1")
    with pytest.raises(ValueError, match="below the directory"):
        OutputDirectory(tmp_path).check([name])
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    (tmp_path / MANIFEST).write_text(json.dumps({**manifest, "files": [name]}))
    with pytest.raises(ValueError, match="below the directory"):
        OutputDirectory(tmp_path)


def test_the_output_directory_must_be_one(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=r"^out: must be a directory"):
        OutputDirectory(tmp_path / "file")
