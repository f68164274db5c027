"""Files changed at random: a problem or a configuration error, soon, and nothing else."""

import re
import signal
from contextlib import contextmanager, suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fmu.config import ConfigurationError, load
from fmu.config.template import files, template, write_template

NASTY = st.sampled_from(
    ['""', "0", "-1", "1e400", "1e308", "1e-308", "nan", "inf", "-inf", "true", "[]", "{}", '"x"', "[[]]", "[0.0]",
     "1979-05-27", '"\\u0000"', '"<b>&"', "9" * 5000, "99999999", '"../../x.mtx"', "[" * 500 + "]" * 500]
)  # fmt: skip
LONGEST_S = 20.0
KINDS = ("frame", "matrices", "python")
FEW = {"max_examples": 40, "deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture]}


@contextmanager
def soon():
    """Stop what hangs."""

    def stop(*_):
        raise TimeoutError(f"more than {LONGEST_S} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module", params=KINDS)
def start(request, tmp_path_factory):
    """Return a template's folder, its file's name and its text, without a reduced model: that takes seconds."""
    folder = tmp_path_factory.mktemp(request.param)
    write_template(request.param, folder)
    text = template(request.param).replace("#: reduction = true ", "reduction = false #", 1)
    few = re.sub(r"elements = \d+", "elements = 2", re.sub(r"(?m)^#: .*\n", "", text))
    return folder, files(request.param)[0], few


def loads_or_complains(folder, name, text):
    """Say whether a text is a problem."""
    (folder / name).write_text(text, encoding="utf-8")
    with soon(), suppress(ConfigurationError):
        load(folder / name)
        return True
    return False


def values(text):
    return [m.span(1) for m in re.finditer(r"(?m)^[^#\n]*?= ([^#\n]+?) *(?:#.*)?$", text)]


def test_it_loads_as_it_is(start):
    assert loads_or_complains(*start)


@settings(**FEW)
@given(data=st.data())
def test_a_value_is_replaced(start, data):
    folder, name, text = start
    first, last = data.draw(st.sampled_from(values(text)))
    loads_or_complains(folder, name, text[:first] + data.draw(NASTY) + text[last:])


@settings(**FEW)
@given(data=st.data())
def test_two_values_are_swapped(start, data):
    folder, name, text = start
    places = values(text)
    (a, b), (c, d) = sorted(data.draw(st.lists(st.sampled_from(places), min_size=2, max_size=2, unique=True)))
    loads_or_complains(folder, name, text[:a] + text[c:d] + text[b:c] + text[a:b] + text[d:])


@settings(**FEW)
@given(data=st.data())
def test_lines_are_lost_or_come_twice(start, data):
    folder, name, text = start
    lines = text.splitlines(keepends=True)
    for _ in range(data.draw(st.integers(1, 3))):
        k, n = data.draw(st.integers(0, len(lines) - 1)), data.draw(st.integers(1, 8))
        copies = data.draw(st.sampled_from([0, 2]))
        lines[k : k + n] = lines[k : k + n] * copies
    loads_or_complains(folder, name, "".join(lines))


@settings(**FEW)
@given(data=st.data())
def test_a_matrix_file_is_changed(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("matrices")
    path = write_template("matrices", folder)
    file = folder / data.draw(st.sampled_from(files("matrices")[1:]))
    content = file.read_bytes()
    k, n = data.draw(st.integers(0, len(content))), data.draw(st.integers(0, 40))
    file.write_bytes(content[:k] + data.draw(st.binary(max_size=20)) + content[k + n :])
    with soon(), suppress(ConfigurationError):
        load(path)
