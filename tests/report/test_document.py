"""What a page consists of."""

import pytest

from fmu.report.document import Table


def test_rows_are_as_long_as_the_header():
    Table("numbers", ("a", "b"), (("1", "2"),))
    with pytest.raises(ValueError, match=r"rows: must have 2 cells \(got \('1',\)\)"):
        Table("numbers", ("a", "b"), (("1", "2"), ("1",)))
