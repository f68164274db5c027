"""The section on frequency response functions, and what pages say of modes that are no data."""

import pytest

from fmu.fem.frf.confirming import FRFCertificate
from fmu.report import plots
from fmu.report.document import Omitted, Pictures
from fmu.report.run import runs_of
from fmu.report.sections import origin, prediction, updating
from fmu.report.sections.frf import functions as frfs


@pytest.fixture(scope="module")
def run(frf_trace):
    return runs_of({"mixture": frf_trace})["mixture"]


def tables(section):
    return [part for part in section.parts if part.kind == "table"]


def test_it_has_a_row_and_a_figure_for_each_function(run):
    section = frfs.frfs(run)
    table, channels = tables(section)
    assert [row[0] for row in table.rows] == ["2 x / 2 x", "0 x / 2 x"]
    assert [row[1] for row in table.rows] == ["112", "112"]
    assert [row[6] for row in table.rows] == ["8", "8"]
    assert len([part for part in section.parts if isinstance(part, Pictures)]) == 2
    assert [row[0] for row in channels.rows] == ["2 x", "0 x"]
    assert [row[1] == "–" for row in channels.rows] == [True, False]  # only one gain is inferred
    said = section.parts[0].words
    assert "No FRF of 2 differs" in said
    assert "16 others were not used" in said


def test_errors_of_channels_have_their_own_axes(frf_trace):
    """Damping is of the model."""
    axes = plots.plot_parameter_updates({"mixture": frf_trace})
    drawn = {axis.get_ylabel(): [label.get_text() for label in axis.get_xticklabels()] for axis in axes}
    assert drawn["value"] == ["k1", "k2", "k3", "zeta1", "zeta2", "zeta3"]
    assert list(drawn) == ["value", "error parameter / s"]


def test_the_certificate_of_the_reduced_functions_is_on_the_page(frf_trace):
    assert isinstance(origin.certificate(runs_of({"mixture": frf_trace})["mixture"]), Omitted)  # of three masses
    other = frf_trace.copy()
    found = FRFCertificate(draws=4, shift=0.02, lines=12, direct_error=0.005)
    other.attrs = frf_trace.attrs | found.attributes()
    section = origin.certificate(runs_of({"mixture": other})["mixture"])
    assert section.parts[-1].words == found.sentence()
    assert "at most 0.02 of its standard deviations" in found.sentence()


def test_modes_that_are_no_data_are_not_judged(run):
    assert isinstance(prediction.predictive(run), Omitted)
    assert isinstance(prediction.left_out(run), Omitted)
    section = updating.frequencies(run)
    assert updating.NOT_DATA in section.parts[0].words
    assert "90 %, with noise, Hz" not in tables(section)[0].header


def test_a_run_on_modes_has_no_such_section(beam_traces):
    other = runs_of({"hmc": beam_traces["hmc"]})["hmc"]
    assert isinstance(frfs.frfs(other), Omitted)
