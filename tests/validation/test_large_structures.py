"""The study of large structures: its structures and its page."""

import json

import numpy as np
import pytest

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from tests.validation.large_files import RHO, SIDES, STEEL, plate, write_plate, write_space_frame, write_wing
from tests.validation.large_run import phases
from tests.validation.large_structures import RUNS, page


def made_up(run):
    """Return a run as if it had been measured."""
    certificate = {
        "bound_draws": 64.0,
        "bound": 2e-6,
        "draws": 16.0,
        "frequency_error": 2e-7,
        "bound_exceeded": 0.0,
    }
    certificate |= {"log_prob_error": 2e-3, "log_prob_tolerance": 0.01}
    found = {"n_dof": 55_500, "wall_s": 500.0, "cpu_s": 450.0, "phases": {"training": 180.0, "report": 20.0}}
    found |= {"sampler": "mixture", "solves": 3316, "rhat": 1.007, "ess": 725.0, "peak_gib": 1.7, "code": 0}
    return vars(run) | found | {"certificate": certificate, "said": ["a note"]}


def test_the_page_says_what_was_measured():
    text = page({name: made_up(run) for name, run in list(RUNS.items())[:2]}, "2 of 4 runs")
    assert "(2 of 4 runs)" in text
    assert "| quantity | the frame, 55 500 DOF | the plate, 55 500 DOF |" in text
    assert "| largest bound of a frequency's error | 2e-6 | 2e-6 |" in text
    assert "- the plate: a note" in text


def test_the_largest_structures_that_fit_follow_from_the_peaks():
    solid = made_up(RUNS["the fine plate"]) | {"n_dof": 100_000, "peak_gib": 1.25}
    text = page({"the fine plate": solid}, "1 of 4 runs")
    assert "A solid of 0.8 million degrees of freedom would fill 20 GiB" in text  # 16^(3/4) = 8 times as many
    assert "would fill" not in page({"the plate": made_up(RUNS["the plate"])}, "1 of 4 runs")


def test_phases_last_as_long_as_they_tell_and_those_of_samplers_from_their_first_line_on():
    lines = ["Searching"]
    for second, name, elapsed in PHASES:
        line = {"time": f"2026-11-23T06:00:{second:06.3f}Z", "phase": name}
        lines.append(json.dumps(line | ({} if elapsed is None else {"elapsed_s": elapsed})))
    found = phases("\n".join(lines), 30.0)
    assert found == pytest.approx(
        {"training": 9.0, "draws": 2.0, "leaving out": 5.0, "search": 1.0, "no phase": 14.0}
    )


PHASES = (
    (4.0, "training", 3.0),
    (8.0, "training", 7.0),  # the same again
    (11.0, "training", 2.0),
    (12.0, "draws", None),
    (14.0, "draws", None),
    (17.0, "search", 1.0),  # within the next
    (20.0, "leaving out", 5.0),
)


def test_the_plate_converges_as_trilinear_elements_do():
    """Its lowest frequency lies a little above that of a beam of its section; the error is of the size h²."""
    found = []
    for n in (1, 2, 4):
        stiffness, mass = plate((25 * n, 3, n))
        found.append(frequency_hz(eigen(STEEL * sum(stiffness), mass, 1)[0])[0])
    assert 3.0 < (found[0] - found[1]) / (found[1] - found[2]) < 5.0
    length, _, thickness = SIDES
    beam = 1.8751**2 / (2.0 * np.pi) * thickness / np.sqrt(12.0) / length**2 * np.sqrt(STEEL / RHO)
    assert 1.0 < found[2] / beam < 1.1


@pytest.mark.validate
@pytest.mark.parametrize(
    ("write", "cells", "parameters", "n_dof"),
    [
        (write_plate, (12, 3, 1), 6, 3 * 12 * 4 * 2),
        (write_wing, (48, 6, 2), 5, 6 * (48 * 16 + 16 * 5)),
        (write_space_frame, (6, 4), 4, 6 * (7 * 5 + 6 * 4) - 3 * 20),
    ],
)
def test_the_structures_are_problems_that_can_be_loaded(write, cells, parameters, n_dof, tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    problem = fmu.load(write(tmp_path, cells))
    assert problem.names == tuple(f"E{k}" for k in range(1, parameters + 1))
    assert problem.model.structure.n_dof == n_dof
    assert np.all(np.abs(problem.frequencies(problem.start) / problem.data.frequencies_hz - 1.0) < 0.1)
