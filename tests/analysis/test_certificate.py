import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import fmu
from fmu.analysis.certificate import CertificateWarning, Effort, certify
from fmu.fem.reduced.basis import ReducedBlock
from fmu.posterior.reduction.tolerance import Tolerance

pytestmark = pytest.mark.usefixtures("certified")


@pytest.fixture(scope="module")
def problem():
    return fmu.cases.load("cantilever-section")


@pytest.fixture(scope="module")
def trace(problem, certified):
    maxima = fmu.find_map(problem, starts=2)
    return fmu.sample(problem, "slice", draws=40, warmup=40, chains=2, seed=3, maxima=maxima)


def test_certificate_is_within_its_tolerances(trace, problem):
    attrs = trace.attrs
    assert attrs["certificate_bound_draws"] == 80  # all of them
    assert attrs["certificate_draws"] == 16
    assert 0 < attrs["certificate_bound_median"] <= attrs["certificate_bound"] <= 1e-6
    assert attrs["certificate_frequency_error"] <= attrs["certificate_bound"] + 1e-8
    assert attrs["certificate_bound_exceeded"] == 0
    assert 0 < attrs["certificate_frequency_error"] <= 1e-6
    assert 0 < attrs["certificate_log_prob_error"] <= 1e-3
    assert attrs["certificate_pairing_changes"] == attrs["certificate_full_solves"] == 0
    assert attrs["certificate_frequency_tolerance"] == 1e-6
    assert attrs["certificate_log_prob_tolerance"] == 1e-3
    assert certify(trace, problem).attributes().items() <= attrs.items()


def test_nothing_is_promised_where_a_chain_far_off_began(problem, monkeypatch):
    walk = fmu.MetropolisHastings(fmu.RandomWalk(0.03))
    maxima = fmu.find_map(problem, starts=2)
    trace = fmu.sample(problem, walk, draws=200, warmup=0, chains=1, init="start", seed=1, maxima=maxima)
    assert np.ptp(trace["sample_stats"]["lp"].to_numpy()) > 1000
    error = trace.attrs["certificate_log_prob_error"]
    assert 0 < error <= 1e-3
    monkeypatch.setattr(problem, "tolerance", replace(problem.tolerance, depth=np.inf))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CertificateWarning)
        assert certify(trace, problem).log_prob_error > 10.0 * error


def test_a_basis_that_is_too_small_is_found_out(trace, problem, monkeypatch):
    blocks = list(problem.model.cheap.blocks)
    b = next(i for i, block in enumerate(blocks) if isinstance(block, ReducedBlock))
    blocks[b] = blocks[b].truncate(7)
    monkeypatch.setattr(problem.model.cheap, "solve", partial(problem.model.pairing.solve, tuple(blocks)))
    with pytest.warns(CertificateWarning, match="outside its tolerance"):
        certificate = certify(trace, problem)
    assert certificate.frequency_error > 1e-6


def test_a_bound_that_does_not_hold_is_found_out(trace, problem, monkeypatch):
    whole = problem.model.frequency_bound
    monkeypatch.setattr(problem.model, "frequency_bound", lambda theta: 0.0 * whole(theta))
    with pytest.warns(CertificateWarning, match="error above its bound at 16 draws"):
        assert certify(trace, problem, effort=Effort(rounding=0.0)).bound_exceeded == 16


@pytest.mark.parametrize(("mode", "exceeded"), [(0, 0), (2, 16)])
def test_an_error_above_its_bound_may_be_rounding_of_the_full_model(trace, problem, monkeypatch, mode, exceeded):
    """An eigenvalue errs by 2e-16 λ_max, which is 5e-8 of the lowest and 1e-10 of the third."""
    exact = problem.model.confirmed_modes
    factor = 1.0 - 6e-8 * (np.arange(5) == mode)
    monkeypatch.setattr(
        problem.model,
        "confirmed_modes",
        lambda theta: replace(modes := exact(theta), eigenvalues=modes.eigenvalues * factor),
    )
    with warnings.catch_warnings(record=True, category=CertificateWarning) as told:
        warnings.simplefilter("always")
        assert certify(trace, problem).bound_exceeded == exceeded
    said = ["the error of the reduced model is above its bound, but within its tolerance"] * bool(exceeded)
    assert [str(one.message).split(";")[0] for one in told] == said


def test_of_a_large_structure_fewer_draws_are_bounded(trace, problem):
    certificate = certify(trace, problem, effort=Effort(work=0))
    assert certificate.bound_draws == 64
    assert certificate.draws == 16


def test_of_a_large_structure_fewer_draws_are_solved(trace, problem):
    assert certify(trace, problem, effort=Effort(work=0, large=100)).draws == 8


def test_a_tolerance_that_holds_where_the_posterior_lives_is_told_with_the_other(trace, problem, monkeypatch):
    assert "certificate_frequency_elsewhere" not in trace.attrs
    monkeypatch.setattr(problem.model, "elsewhere", 1e-3)
    certificate = certify(trace, problem)
    assert certificate.frequency_elsewhere == 1e-3
    assert certificate.frequency_tolerance == 1e-6


def test_a_looser_promise_is_kept_where_a_stricter_one_is_not(trace, problem, monkeypatch):
    """The loose basis, held against its own tolerance and then against one of 1e-8."""
    loose = fmu.UpdatingProblem.reduced(
        problem.model.structure, problem.data, problem.parameters, beta=problem.likelihood.beta, reduction=1e-3
    )
    certificate = certify(trace, loose)
    assert certificate.frequency_tolerance == 1e-3
    assert certificate.log_prob_tolerance == 0.1
    assert 1e-8 < certificate.frequency_error <= 1e-3
    assert certificate.log_prob_error <= 0.1
    monkeypatch.setattr(loose, "tolerance", Tolerance(1e-8, 0.1))
    with pytest.warns(CertificateWarning, match=r"frequency error up to \S+ \(tolerance: 1e-08\)"):
        certify(trace, loose)


def test_a_wrong_rank_is_found_out(trace, problem, monkeypatch):
    rank = problem.model.pairing
    swapped = type(rank)(rank.block, (0, 1, 2, 4, 3))
    monkeypatch.setattr(problem.model.cheap, "solve", partial(swapped.solve, problem.model.cheap.blocks))
    with pytest.warns(CertificateWarning):
        assert certify(trace, problem).pairing_changes == 16


def test_a_density_without_a_reduced_model_needs_none(trace, problem):
    assert certify(trace, object()) is None
    full = fmu.UpdatingProblem(problem.model.structure, problem.data, problem.parameters, pairing="index")
    assert certify(trace, full) is None


def test_solves_of_the_full_model_are_counted(problem):
    before = problem.model.full_solves
    problem.frequencies(np.stack([problem.upper * 1.1, problem.start]))
    assert problem.model.full_solves == before + 1


def test_every_configuration_of_several_tests_is_certified(problem, monkeypatch):
    structure, f = problem.model.structure, np.asarray(problem.data.frequencies_hz)[:3]
    data = fmu.ModalData(f, numbers=problem.data.numbers[:3], sd_hz=0.01 * f)
    place = structure.dofs[-1][0]
    tests = [fmu.Test("plain", data), fmu.Test("again", data), fmu.Test("loaded", data, masses={place: 0.01})]
    joint = fmu.JointProblem(structure, tests, problem.parameters, pairing="index")
    assert len(joint.model.parts) == 2
    trace = fmu.sample(joint, "slice", draws=20, warmup=5, chains=2, seed=3, maxima=fmu.find_map(joint, starts=2))
    assert trace.attrs["certificate_bound_draws"] == 40
    assert trace.attrs["certificate_draws"] == 6
    assert 0 < trace.attrs["certificate_frequency_error"] <= trace.attrs["certificate_bound"] + 1e-8 <= 1e-6
    assert 0 < trace.attrs["certificate_log_prob_error"] <= 1e-3
    loaded = joint.model.parts[1]
    poor = tuple(b.truncate(b.size // 2) if isinstance(b, ReducedBlock) else b for b in loaded.cheap.blocks)
    monkeypatch.setattr(loaded.cheap, "solve", partial(loaded.pairing.solve, poor))
    with pytest.warns(CertificateWarning, match="outside its tolerance"):
        certify(trace, joint)
