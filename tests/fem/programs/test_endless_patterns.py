"""A regular expression that backtracks without end is stopped at the limit of the run."""

import pytest

import fmu


def test_a_pattern_that_never_ends(tmp_path):
    file = tmp_path / "output.txt"
    file.write_text("x" * 60 + "\nf = 12.5\nf = 13.5\n")
    endless = fmu.FoundFrequencies("output.txt", r"(?:x+x+)+y(\d)")
    with pytest.raises(ValueError, match=r"^pattern: must be matched within 0.5 s in output.txt \(got .*longer\)"):
        endless.read(file, 0.5)
    assert fmu.FoundFrequencies("output.txt", r"^f = (.*)$").read(file).tolist() == [12.5, 13.5]
