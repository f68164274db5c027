"""What a page consists of."""

import pytest

from fmu.report.document import PageTable


def test_rows_are_as_long_as_the_header():
    PageTable("numbers", ("a", "b"), (("1", "2"),))
    with pytest.raises(ValueError, match=r"rows: must have 2 cells \(got \('1',\)\)"):
        PageTable("numbers", ("a", "b"), (("1", "2"), ("1",)))
