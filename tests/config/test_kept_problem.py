"""The problem and the options that a run saves are the ones that it reads back."""

import json

import pytest

from fmu.config.kept import FILE, ORIGIN, KeptProblem, read_saved


@pytest.mark.parametrize("pairing", [None, "index"])
def test_the_pairing_of_the_file_stays_so(tmp_path, pairing):
    model = tmp_path / "own.toml"
    model.write_text('name = "own"\n')
    directory = tmp_path / "out"
    directory.mkdir()
    KeptProblem(model, tmp_path, pairing, {"draws": 3}, ("mh",)).save(directory)
    assert json.loads((directory / ORIGIN).read_text())["pairing"] == pairing
    found = read_saved(directory)
    assert (found.pairing, found.orders, found.finished) == (pairing, {"draws": 3}, ("mh",))
    assert found.file == directory / FILE
    assert found.folder.resolve() == tmp_path.resolve()
