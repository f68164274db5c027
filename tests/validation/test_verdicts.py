"""The study of verdicts: its quadrature, and when it turns red."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from tests.gradients import assert_gradient
from tests.samplers.targets import SkewedGumbel, TwoModes
from tests.two_storeys import quadrature
from tests.validation import verdicts, verdicts_page
from tests.validation.known import FURTHER, KNOWN, Boxed, Known, Moments, Normal, moments
from tests.validation.verdicts import (
    ALL,
    FEWEST_WITH_CANDIDATES,
    JUMPS,
    LENGTHS,
    ONE_PLACE,
    USUAL,
    WITH_CANDIDATES,
    WRONG,
    Job,
    Outcome,
    Study,
    outcome,
)

BY_NAME = {known.name: known for known in KNOWN}


@pytest.mark.parametrize("sampler", sorted({job.sampler for job in verdicts.jobs()}))
def test_every_planned_sampler_takes_a_plain_density(sampler):
    job = Job(KNOWN[0], sampler, "short", USUAL, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LENGTHS, "short", LENGTHS["short"]._replace(warmup=10, draws=10))
        assert outcome(job).draws == 10


@pytest.mark.parametrize(
    ("target", "lower", "upper", "cells"),
    [
        (Normal([1.0, 2.0], [1.0, 3.0], 0.99), [-19.0, -28.0], [21.0, 32.0], 300),
        (TwoModes(), [-8.0] * 2, [8.0] * 2, 60),
        (SkewedGumbel(), [-3.0, -5.0, -11.0], [25.0, 25.0, 20.0], 40),
    ],
)
def test_the_quadrature_has_the_moments_of_densities_that_are_known(target, lower, upper, cells):
    found = moments(Boxed(target, lower, upper).log_prob, np.array(lower), np.array(upper), cells)
    sd = np.sqrt(np.diag(target.covariance))
    assert_allclose(found.mean / sd, target.mean / sd, atol=1e-5)
    assert_allclose(found.variance, sd**2, rtol=1e-4)


@pytest.mark.parametrize("known", [one for one in FURTHER if " 2 parameters" in one.name], ids=lambda k: k.name)
def test_formulas_give_what_the_quadrature_gives(known):
    found = known.integrated(120)
    assert_allclose(found.mean, known.truth.mean, atol=1e-6)
    assert_allclose(found.variance, known.truth.variance, rtol=1e-5)
    assert found.log_mass == pytest.approx(known.truth.log_mass, abs=1e-6)


@pytest.mark.parametrize("known", FURTHER, ids=lambda known: known.name)
def test_gradients_of_the_further_targets(known):
    rng, density = np.random.default_rng(1), known.density
    theta = density.sample_prior(rng, 5)
    assert_gradient(density.log_prob_and_grad(theta)[1], density.log_prob, theta, 1e-6, rtol=1e-5, atol=1e-4)


def test_the_quadrature_of_a_frame_is_that_without_fmu():
    found, exact = BY_NAME["shear-2dof"].integrated(120), quadrature(400)
    assert_allclose(found.mean, exact.mean, rtol=1e-3)
    assert_allclose(np.sqrt(found.variance), exact.sd, rtol=1e-3)


@pytest.mark.validate
@pytest.mark.parametrize("known", KNOWN, ids=lambda known: known.name)
def test_a_coarser_grid_gives_the_same(known):
    coarser, sd = known.integrated(int(0.7 * known.cells)), np.sqrt(known.truth.variance)
    assert_allclose(coarser.mean / sd, known.truth.mean / sd, atol=1e-3)
    assert_allclose(coarser.variance, known.truth.variance, rtol=1e-3)


def runs(count=500):
    """Runs that converged, with errors like those of a right sampler whose MCSE are known."""
    rng = np.random.default_rng(2)
    return [
        Outcome(
            KNOWN[0].name, "mixture" if seed % 10 else "mh", "default", USUAL, seed, True, False, True, "", 1000,
            of_means=tuple(rng.standard_normal(2)), of_variances=tuple(rng.standard_normal(2)),
            mcse=tuple(np.exp(0.1 * rng.standard_normal(2))), ess=500.0, processor_s=1.0,
        )
        for seed in range(count)
    ]  # fmt: skip


def test_right_runs_pass():
    found = Study(runs())
    assert found.failures == []
    assert verdicts_page.verdict(found).startswith("**0 of 500 runs")
    assert found.most_wrong == pytest.approx(0.006, abs=1e-4)  # 3/n
    assert found.freedom == pytest.approx(0.5 / 0.1**2, rel=0.1)
    assert 1e-5 < found.expected_beyond(5.0) < 0.01


@pytest.mark.parametrize("errors", [(0.0, 5.1), (-6.0, 0.0), (np.nan, 0.0)])
def test_one_wrong_run_of_five_hundred_turns_the_page_red(errors):
    (first, *others) = runs()
    wrong = replace(first, of_means=errors)
    found = Study([wrong, *others])
    assert len(found.failures) == 1
    assert verdicts_page.verdict(found).startswith("**Gates that fail:**")
    assert not Study([replace(wrong, converged=False), *others]).failures


def test_what_no_search_could_tell_is_counted_apart_and_must_be_said():
    (first, *others) = runs(501)
    alone = replace(first, name="two maxima, far", of_means=(40.0, 30.0))
    found = Study([alone, *others])
    assert found.alone == [alone]
    assert found.failures == []
    assert len(found.converged) == 500
    assert Study([replace(alone, told=False), *others]).failures
    assert Study([replace(alone, searched=True, told=False), *others]).failures


def test_a_maximum_that_a_chain_of_a_mixture_has_been_at_may_not_be_lost():
    (first, *others) = runs(501)
    alone = replace(first, name="two modes, 10 parameters", sampler="mixture", of_means=(40.0, 30.0))
    assert Study([replace(alone, been_everywhere=False), *others]).failures == []
    assert Study([replace(alone, been_everywhere=True), *others]).failures
    assert Study([replace(alone, been_everywhere=True, sampler="mh"), *others]).failures == []


def test_too_few_runs_turn_it_red():
    assert Study(runs(499)).failures == ["499 runs; at least 500 are needed"]
    few = [replace(one, sampler="mh") if k < 60 else one for k, one in enumerate(runs())]
    assert Study(few).failures == ["396 runs with mixture proposals; at least 400 are needed"]


@pytest.mark.validate
def test_a_run_at_one_of_two_maxima_is_wrong_and_says_what_it_was_judged_by():
    found = outcome(Job(BY_NAME["two maxima, far"], "slice", "until good", ONE_PLACE, 1))
    assert (found.converged, found.is_wrong, found.told, found.searched) == (True, True, True, False)


def test_a_run_is_wrong_against_another_truth(monkeypatch):
    traces, whole = [], fmu.sample

    def made_once(*given, **options):
        traces.append(traces[0] if traces else whole(*given, **options))
        return traces[0]

    monkeypatch.setattr(fmu, "sample", made_once)
    known = Known("box", "", lambda: Boxed(Normal([0.0, 0.0], [0.3, 0.4], 0.5), -2.0, 2.0), 40)
    right = outcome(Job(known, "slice", "until good", USUAL, 1))
    assert (right.converged, right.is_wrong) == (True, False)
    mean, variance, mass = known.truth
    known.__dict__["truth"] = Moments(mean + np.array([0.5, 0.0]) * np.sqrt(variance), variance, mass)
    wrong = outcome(Job(known, "slice", "until good", USUAL, 1))
    assert wrong.is_wrong
    assert len(traces) == 2


def test_every_sampler_and_length_is_in_the_study():
    jobs = list(verdicts.jobs())
    apart = [job for job in jobs if job.known.one_place and not job.known.is_searched and job.start != ALL]
    assert len(jobs) - len(apart) >= verdicts.FEWEST_RUNS
    assert sum(job.sampler in WITH_CANDIDATES for job in jobs if job not in apart) >= FEWEST_WITH_CANDIDATES
    assert {(job.sampler, job.length) for job in jobs if JUMPS not in job.sampler} == {
        (s, length) for s in verdicts.OF_ANY_DENSITY for length in LENGTHS
    }
    separated = {known for known in (*KNOWN, *FURTHER) if known.one_place is not None}
    for sampler in WITH_CANDIDATES:
        assert {(job.known, job.start) for job in jobs if job.sampler == sampler} >= {
            *((known, ONE_PLACE) for known in separated),
            *((known, ALL) for known in separated if known.maxima is not None),
        }
    assert len({job.key for job in jobs}) == len(jobs)


def test_the_page_shows_every_posterior(tmp_path, monkeypatch):
    monkeypatch.setattr(verdicts_page, "jobs", lambda: iter(()))  # to count them makes every density
    alone = replace(runs(1)[0], name="two maxima, far", of_means=(40.0, 30.0))
    assert alone.sampler == "mh"
    bad = replace(runs(1)[0], seed=900, converged=False, of_means=(9.0, 9.0))
    verdicts_page.write(Study([*runs(), bad, alone]), tmp_path)
    page = (tmp_path / "verdicts.md").read_text(encoding="utf-8")
    assert "| truncated Gaussian | bounded | 2 | 50 of 51: " in page
    assert "| two maxima, far | no | default | 1 of 1, 1 wrong | - |" in page
    assert "| mixture | importance | 450 | 450 | - | - | 0 |" in page


@pytest.mark.validate
def test_a_maximum_that_warm_up_found_is_visited_before_a_run_is_called_converged():
    """With 129 draws of each chain no draw was at the maximum of 5 %, and R-hat and ESS were good."""
    job = Job(BY_NAME["two maxima, one of 5 %"], "hmc" + JUMPS, "until good", USUAL, 1)
    few = LENGTHS["until good"]._replace(draws=129, until_ess=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LENGTHS, "until good", few)
        short = outcome(job)
    assert short.worst > WRONG
    assert not short.converged
    assert "all chains may have missed it" in short.reason
    enough = outcome(job)
    assert enough.converged
    assert enough.worst < WRONG
