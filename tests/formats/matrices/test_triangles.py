"""Symmetric files store one entry of each pair."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fmu.formats.matrices.read import read_matrix

TWO = np.array([[2.0, -1.0], [-1.0, 2.0]])


def test_both_triangles_of_a_symmetric_file_are_refused(tmp_path):
    """Their sum would double the entries off the diagonal. One entry of a pair may be in either triangle."""
    head = "%%MatrixMarket matrix coordinate real symmetric\n2 2 {}\n1 1 2\n2 2 2\n"
    (tmp_path / "k.mtx").write_text(head.format(4) + "2 1 -1\n1 2 -1\n")
    both = "".join(f"{x:26.18E}" for x in (2.0, -1.0, -1.0, 2.0))
    lines = [f"{'k':72}{'fmu':8}", "".join(f"{n:14d}" for n in (4, 1, 1, 2, 0))]
    lines += [f"{'RSA':14}" + "".join(f"{n:14d}" for n in (2, 2, 4, 0))]
    lines += [f"{'(10I8)':16}{'(10I8)':16}{'(3D26.18)':20}{'':20}", f"{1:8d}{3:8d}{5:8d}"]
    lines += [f"{1:8d}{2:8d}{1:8d}{2:8d}", both[:78], both[78:], ""]
    (tmp_path / "k.rsa").write_text("\n".join(lines))
    for name in ("k.mtx", "k.rsa"):
        with pytest.raises(ValueError, match=r"must have each pair of entries once \(it has both of some\)"):
            read_matrix(tmp_path / name)
    (tmp_path / "k.mtx").write_text(head.format(3) + "1 2 -1\n")
    assert_array_equal(read_matrix(tmp_path / "k.mtx").toarray(), TWO)
