"""What tests of several folders share: two workers take longer to start than what most of these tests do."""

import pytest

import fmu


@pytest.fixture(scope="session")
def engine():
    """Return an engine of two workers, which starts those anew that a test has killed."""
    with fmu.engine(workers=2) as engine:
        yield engine
