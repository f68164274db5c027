"""No figure reaches pyplot, no setting of matplotlib stays changed."""

import matplotlib as mpl
import pytest


@pytest.fixture(autouse=True)
def _matplotlib_is_left_alone():
    from matplotlib import pyplot

    before = dict(mpl.rcParams)
    yield
    assert pyplot.get_fignums() == []
    assert dict(mpl.rcParams) == before
