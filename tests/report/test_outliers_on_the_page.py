"""The part of the page on tests that may be outliers."""

from types import SimpleNamespace

import xarray as xr

from fmu.report.sections.tests import _outliers


def run_of(p):
    """Return a run of four tests that are outliers with the probabilities `p`, each by the value of k1 alone."""
    tests = [f"day {t + 1}" for t in range(4)]
    group = xr.Dataset(
        {"outlier": ("test", p), "outlier_of": (("population", "test"), [p, [0.0] * 4])},
        coords={"population": ["k1", "k2"], "test": tests},
    )
    return SimpleNamespace(trace=xr.DataTree.from_dict({"populations": group}))


def test_outliers_are_named_and_listed_by_their_probability():
    words, table = _outliers(run_of([0.01, 0.6, 0.06, 0.995]))
    assert words.words.startswith("Probably outliers: day 4, day 2. ")
    assert "The expected number of outliers is 1.7 of 4 tests." in words.words
    assert table.header == ("test", "P(outlier)", "of k1", "of k2")
    assert [row[0] for row in table.rows] == ["day 4", "day 2", "day 3"]
    assert table.rows[1][1:3] == ("60 %", "60 %")


def test_no_table_of_tests_that_are_hardly_outliers():
    (words,) = _outliers(run_of([0.01, 0.02, 0.03, 0.0]))
    assert words.words.startswith("No test is probably an outlier.")
