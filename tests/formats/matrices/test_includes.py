"""INCLUDE in decks of Nastran: the files are read in its place, inside the folder of the deck and nowhere else."""

import pytest

import fmu
from fmu.formats.matrices.limits import RefusedError
from fmu.formats.matrices.nastran import includes
from fmu.formats.models.read import read_beside, read_mesh

NODES = "GRID,5,,0.,0.,0.\nGRID,9,,1.,0.,0.\n"
BAR = "CBAR,1,1,5,9,0.,0.,1.\n"
DMIG = "DMIG,K,0,6,1,0\nDMIG,K,5,1,,5,1,2.\n"
MASS = "DMIG,M,0,6,1,0\nDMIG,M,5,1,,5,1,1.\n"


def written(folder, **files):
    """Write a deck whose included files are in folders; the names have __ for / and _ for the dot."""
    for name, text in files.items():
        path = folder / name.replace("__", "/").replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder / "deck.bdf"


@pytest.mark.parametrize(
    "entry",
    [
        "INCLUDE 'parts/nodes.bdf'",
        'include "parts/nodes.bdf"  $ the nodes',
        "INCLUDE parts/nodes.bdf $ without quotes",
        "INCLUDE = 'parts/nodes.bdf'",
        "INCLUDE 'parts\\nodes.bdf'",
        "INCLUDE 'par\n  ts/nodes\n   .bdf'",
        "INCLUDE 'parts/../parts/nodes.bdf'",
    ],
)
def test_names_are_relative_to_the_deck(tmp_path, entry):
    deck = written(tmp_path / "model", deck_bdf=f"BEGIN BULK\n{entry}\n{BAR}ENDDATA\n", parts__nodes_bdf=NODES)
    mesh = read_mesh(deck)
    assert mesh.nodes.tolist() == [5, 9]
    assert mesh.elements == ((5, 9),)
    assert read_beside(deck) == [deck.parent / "parts" / "nodes.bdf"]


def test_included_files_include_others_beside_them_or_beside_the_deck(tmp_path):
    deck = written(
        tmp_path,
        deck_bdf="INCLUDE 'a/first.bdf'\n",
        a__first_bdf="INCLUDE 'second.bdf'\nINCLUDE 'a/third.bdf'\n",
        a__second_bdf=NODES,
        a__third_bdf=BAR + "ENDDATA\nINCLUDE 'absent.bdf'\n",
    )
    assert read_mesh(deck).elements == ((5, 9),)


def test_matrices_of_included_files(tmp_path):
    deck = written(tmp_path, deck_bdf=f"{NODES}INCLUDE 'k.pch'\nINCLUDE 'm.pch'\n", k_pch=DMIG, m_pch=MASS)
    model = fmu.read_model(deck, mesh=deck)
    assert (model.stiffness[0, 0], model.mass[0, 0]) == (2.0, 1.0)


@pytest.mark.parametrize("name", ["../other.bdf", "/etc/passwd", "link.bdf", "C:\\m\\other.bdf", "away/other.bdf"])
def test_nothing_outside_the_folder_is_read(tmp_path, name):
    deck = written(tmp_path / "model", deck_bdf=f"INCLUDE '{name}'\n")
    (tmp_path / "other.bdf").write_text(NODES)
    (deck.parent / "link.bdf").symlink_to(tmp_path / "other.bdf")
    (deck.parent / "away").symlink_to(tmp_path)
    with pytest.raises(ValueError, match=r"must be inside the folder of the deck \(INCLUDE '.*: copy it there"):
        read_mesh(deck)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"deck_bdf": "INCLUDE 'deck.bdf'\n"}, "must not include a file within itself"),
        (
            {"deck_bdf": "INCLUDE 'a.bdf'\n", "a_bdf": "INCLUDE 'deck.bdf'\n"},
            "must not include a file within itself",
        ),
        ({"deck_bdf": "INCLUDE 'absent.bdf'\n"}, r"INCLUDE must name a file \(no such file: .*absent.bdf"),
        ({"deck_bdf": "INCLUDE 'never\nending\n"}, "must have a name that ends with '"),
        ({"deck_bdf": "INCLUDE ''\n"}, "INCLUDE must name a file .*is a directory"),
        ({"deck_bdf": "INCLUDE 'a\0b'\n"}, "NUL"),
    ],
)
def test_it_is_refused_with_a_reason(tmp_path, files, message):
    with pytest.raises(ValueError, match=message):
        read_mesh(written(tmp_path, **files))


def test_depth_number_and_size_are_limited(tmp_path, monkeypatch):
    n = includes.DEEPEST + 1
    chain = {f"f{i}_bdf": f"INCLUDE 'f{i + 1}.bdf'\n" for i in range(1, n)}
    deck = written(tmp_path, deck_bdf="INCLUDE 'f1.bdf'\n", **chain)
    (tmp_path / f"f{n}.bdf").write_text(NODES)
    with pytest.raises(ValueError, match=f"at most {includes.DEEPEST} files that include each other"):
        read_mesh(deck)
    deck.write_text("INCLUDE 'f2.bdf'\n")
    assert read_mesh(deck).nodes.tolist() == [5, 9]
    twice = {f"t{i}_bdf": f"INCLUDE 't{i + 1}.bdf'\n" * 2 for i in range(1, 14)}
    written(tmp_path, deck_bdf="INCLUDE 't1.bdf'\n", **twice, t14_bdf="$\n")  # 16383 files
    with pytest.raises(RefusedError, match="at most 1000 files"):
        list(includes.deck_lines(deck))
    monkeypatch.setattr(includes, "LARGEST_FILE", 60)
    deck.write_text("INCLUDE 'f17.bdf'\n" * 2)
    with pytest.raises(RefusedError, match="of 60 bytes in all"):
        list(includes.deck_lines(deck))
