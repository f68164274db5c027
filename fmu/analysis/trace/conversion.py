"""Convert a sampler run to an ArviZ trace, and store traces in netCDF files.

All samplers share one conversion, so groups, variables and dimensions ``(chain, draw, *)`` have the same names in
all traces. For an ensemble sampler the draw dimension has length steps × walkers and is step-major; the trace's
attributes give the number of walkers.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.evidence_estimators import tempering_group
from fmu.analysis.frf.predictions import GROUP as FRFS
from fmu.analysis.frf.predictions import frf_groups
from fmu.analysis.trace.densities import (
    discrepant_likelihood,
    has_prior,
    has_several_tests,
    is_updating,
    names_of,
    start_of,
    units_of,
)
from fmu.analysis.trace.distinct_draws import DistinctDraws, evaluate_in_parts
from fmu.analysis.trace.misfit import misfit_group, quantities_group
from fmu.analysis.trace.modal_states import drawn_structure
from fmu.analysis.trace.netcdf import from_netcdf, to_netcdf
from fmu.analysis.trace.provenance import attributes
from fmu.analysis.trace.reading import check_trace
from fmu.arguments import check_arguments
from fmu.durable_files import write_durably
from fmu.interruption import shielded
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.mixture.kernel import CANDIDATE, LOG_WEIGHT
from fmu.samplers.registry import SAMPLERS
from fmu.samplers.tempering.kernel import LOG_LIKELIHOOD
from fmu.types import AnyArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem
    from fmu.samplers.loop.record import Draws, RunResult
    from fmu.types import LogDensity

GIVEN_OTHERS, ONE_MORE_TEST, NEW_MEASUREMENT = "frequency_given_others", "one_more_test", "new_measurement"
PRIOR_DRAWS = 2000
PRIOR_STREAM, NOISE_STREAM, START_STREAM, NEXT_TEST_STREAM, FRF_STREAM, SCORED_TEST_STREAM = range(6)
_OUTSIDE_THE_CHAINS = 2**32 - 1  # a task number that no run reaches; see `generator`


def to_trace(
    result: RunResult,
    density: LogDensity,
    start: object = None,
    *,
    predictions: bool = True,
    draws_only: bool = False,
    frequency: FloatArray | None = None,
) -> xr.DataTree:
    """Convert a run to an ArviZ trace.

    Parameters
    ----------
    result : RunResult
        Result of `fmu.samplers.loop.run.run`.
    density : LogDensity
        The density that was sampled. An `UpdatingProblem` gives all groups below. A plain log-density gives only
        the groups without frequencies; its parameters are called ``x0``, ``x1``, ... if it has no names.
    start : ndarray or mapping, optional
        Starting points of the chains, if ``result.init`` does not define them: positions from the user, or the
        maxima. They become part of the configuration and its hash.
    predictions : bool
        Whether to solve the model at the draws for the groups that need frequencies.
    draws_only : bool
        Whether to leave out the prior and all groups computed from the draws, except ``tempering``. Convergence
        can be judged without them.
    frequency : ndarray, shape (chains, draws, n_modes), Hz, optional
        Computed frequencies at the draws, if they are known.

    Returns
    -------
    xarray.DataTree
        The groups are:

        - ``posterior`` and ``warmup_posterior``: one variable per parameter, SI units;
        - ``sample_stats`` and ``warmup_sample_stats``: statistics of the sampler;
        - ``log_likelihood``, one value per used mode: ``frequency`` if the only errors of modes are known absolute
          errors of frequencies, ``residual`` for the modal residual, otherwise ``modes``. If errors of different
          modes are correlated, also ``frequency_given_others``; with FRFs also ``frfs``;
        - ``misfit``, and ``quantities`` for masses and displacements: see `fmu.analysis.trace.misfit`;
        - ``posterior_predictive``, Hz, eq. (10) of Boulkaibet et al. (`fmu.paper.published`): ``model_frequency``
          without errors and, with errors of frequencies, ``frequency`` with noise and the discrepancy of a similar
          structure; with a discrepancy ``new_measurement`` of this structure. For repeated tests, these are means
          of the same number of new tests, and ``one_more_test`` is a single test;
        - ``frfs``: see `fmu.analysis.frf.predictions.frf_groups`;
        - ``prior``: draws from the prior inside the bounds;
        - ``observed_data``: ``frequency``; ``tests``, one row per test, if the frequencies are their means;
          ``used``, if not all modes are used in updating; ``of_test``, if there are several tests;
        - ``constant_data``: ``lower``, ``upper``, ``start``, ``beta``, and ``covariance_hz2`` with correlated
          errors; with several tests also ``role``, ``role_of`` and ``role_where`` of each parameter;
        - ``tempering``, for parallel tempering: see `fmu.analysis.evidence_estimators.tempering_group`;
        - ``tests``, for several tests (`fmu.JointProblem`): the structural parameters in every test (chain, draw,
          test); ``populations``, ``loss``, ``loss_by_test`` and ``residual_scores``, if the problem has them; and
          ``structure``, the drawing of the structure, if it can be drawn;
        - ``next_test``, for a hierarchical posterior: the frequencies of one more test like the first,
          ``frequency`` with measurement noise and ``model_frequency`` without.

        The attributes describe how the draws were made.
    """
    import xarray as xr

    names = names_of(density)
    units = units_of(density)
    groups = {
        "posterior": _variables(result.posterior.position, names, units),
        "sample_stats": _stats(result.posterior, density),
        "warmup_posterior": _variables(result.warmup.position, names, units),
        "warmup_sample_stats": _stats(result.warmup, density),
        "constant_data": _constants(density, names),
    }
    if has_prior(density) and not draws_only:
        prior = density.sample_prior(generator(result.seed, PRIOR_STREAM), PRIOR_DRAWS)
        groups["prior"] = _variables(prior[np.newaxis], names, units)
    if LOG_LIKELIHOOD in result.posterior.stats:
        groups["tempering"] = tempering_group(result)
    if has_several_tests(density) and not draws_only:
        groups |= _groups_of_tests(result, density, predictions)
    if predictions and is_updating(density) and not draws_only:
        groups |= _frequency_groups(result, density, frequency)
    trace = xr.DataTree.from_dict(groups)
    trace.attrs = attributes(result, density, start)
    return trace


@check_arguments
def save_trace(trace: xr.DataTree, path: str | os.PathLike[str]) -> Path:
    """Write a trace to a netCDF file; if this fails, no incomplete file is left behind.

    The content is built in memory first, because the HDF5 library cannot close a file on a full disk.

    Parameters
    ----------
    trace : xarray.DataTree
    path : path-like
        Path of the file, which is replaced if it exists.

    Returns
    -------
    Path

    Raises
    ------
    TypeError
        If a variable of the trace holds neither numbers nor text.
    OSError
        If the file cannot be written, for example because the disk is full. An existing file is then unchanged.
    """
    path = Path(path)
    with shielded():
        content = to_netcdf(trace)
        try:
            write_durably(path, content)
        except OSError as error:
            raise OSError(error.errno, error.strerror, os.fspath(path)) from error
    return path


@check_arguments
def load_trace(path: str | os.PathLike[str]) -> xr.DataTree:
    """Read a trace written by `save_trace` into memory.

    Parameters
    ----------
    path : str or os.PathLike

    Returns
    -------
    xarray.DataTree

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not a netCDF file, or does not contain a trace written by fmu.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: must be a trace written by fmu (no such file: {path})")
    try:
        trace = from_netcdf(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"path: must be a trace written by fmu (not a readable netCDF file: {path})") from error
    check_trace(trace, str(path))
    return trace


def load_traces(directory: str | os.PathLike[str]) -> dict[str, xr.DataTree]:
    """Return all traces in a run's directory, keyed by name, in the order of `fmu.samplers.registry.SAMPLERS`.

    Other names follow in alphabetical order. The dict is empty if there are no traces or no such directory.

    Raises
    ------
    ValueError
        If one of the files is not a trace written by fmu.
    """
    places = {name: k for k, name in enumerate(SAMPLERS)}
    paths = sorted(Path(directory).glob("*.nc"), key=lambda path: (places.get(path.stem, len(places)), path.stem))
    return {path.stem: load_trace(path) for path in paths}


def generator(seed: int, stream: int) -> np.random.Generator:
    """Return a random generator for a `stream` number, independent of the chains' own generators.

    The run's seed and the stream determine its numbers.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_OUTSIDE_THE_CHAINS, stream)))


def _sample_coordinates(values: FloatArray) -> dict[str, NDArray[np.int64]]:
    """Return chain and draw coordinates for an array of shape (chains, draws, ...)."""
    return {"chain": np.arange(values.shape[0]), "draw": np.arange(values.shape[1])}


def _variables(position: FloatArray, names: tuple[str, ...], units: tuple[str, ...]) -> xr.Dataset:
    """Return a dataset with one variable per parameter, given positions of shape (chains, draws, ndim)."""
    import xarray as xr

    variables = {
        name: (("chain", "draw"), position[..., i], {"units": unit})
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    }
    return xr.Dataset(variables, coords=_sample_coordinates(position))


def _stats(draws: Draws, density: LogDensity) -> xr.Dataset:
    """Return a dataset of the sampler's statistics, without the log-likelihoods at tempered rungs.

    In the mixture weights P/q, which are stored as logarithms, the density q is converted to SI units.
    """
    import xarray as xr

    log_volume = float(np.sum(np.log(ScaledDensity(density).scale)))
    variables = {
        name: (("chain", "draw"), v + log_volume if name in (LOG_WEIGHT, CANDIDATE) else v)
        for name, v in draws.stats.items()
        if name != LOG_LIKELIHOOD
    }
    return xr.Dataset(variables, coords=_sample_coordinates(draws.position))


def _constants(density: LogDensity, names: tuple[str, ...]) -> xr.Dataset:
    """Return a dataset with bounds, start, parameters' roles, and frequency weights and covariance, if known."""
    import xarray as xr

    known = {"lower": density.lower, "upper": density.upper, "start": start_of(density)}
    variables: dict[str, tuple[object, AnyArray]] = {
        name: ("parameter", np.asarray(values, dtype=float))
        for name, values in known.items()
        if values is not None
    }
    coordinates = {"parameter": list(names)}
    if has_several_tests(density):
        of = ["" if role.of is None else density.layout.structural[role.of].name for role in density.roles]
        variables["role"] = "parameter", np.array([role.kind for role in density.roles])
        variables["role_of"] = "parameter", np.array(of)
        variables["role_where"] = "parameter", np.array([role.where for role in density.roles])
    if is_updating(density) and density.likelihood.beta is not None:
        error = density.likelihood.error
        variables["beta"] = ("mode", np.asarray(density.likelihood.beta, dtype=float))
        coordinates["mode"] = list(density.data.labels)
        if error is not None and error.covariance_hz2 is not None:
            variables["covariance_hz2"] = (("mode", "other_mode"), error.covariance_hz2)
            coordinates["other_mode"] = coordinates["mode"]
    return xr.Dataset(variables, coords=coordinates)


def _frequency_groups(
    result: RunResult, problem: Any, frequency: FloatArray | None = None
) -> dict[str, xr.Dataset]:
    """Return the trace groups that need the model at the draws. Repeated draws are solved only once."""
    import xarray as xr

    coordinates = _sample_coordinates(result.posterior.position) | {"mode": list(problem.data.labels)}
    distinct = DistinctDraws.of(result.posterior.position, result.walkers)
    if frequency is None:
        frequency = distinct.evaluate(problem.frequencies)
    dims = ("chain", "draw", "mode")
    hertz = {"units": "Hz"}
    predicted = {"model_frequency": (dims, frequency, hertz)}
    likelihood = problem.likelihood
    theta, hz = (x.reshape(-1, x.shape[-1]) for x in (result.posterior.position, frequency))
    if likelihood.by_frequencies:
        both = evaluate_in_parts(lambda *part: _stack_terms(*problem.terms_and_misfit(*part)), theta, hz)
        both = both.reshape(*frequency.shape[:2], *both.shape[1:])
    else:
        both = distinct.evaluate(lambda theta: _stack_terms(*problem.terms_and_misfit(theta)))
    together, squares = both[:, :, 0], both[:, :, 1:]
    terms: dict[str, tuple[object, FloatArray]] = {likelihood.terms_name: (dims, together)}
    correlated, discrepant = likelihood.correlated, discrepant_likelihood(problem)
    if correlated is not None:
        others = correlated.log_prob_given_others(frequency) - correlated.log_prob_terms(frequency)
        terms[GIVEN_OTHERS] = (dims, together + likelihood.of_used(others))
    elif discrepant is not None and discrepant.couples_modes:
        of_model = problem.layout.of_model
        found = distinct.evaluate(lambda theta: discrepant.terms_given_others(of_model(theta)))
        terms[GIVEN_OTHERS] = (dims, found[:, :, : together.shape[-1]])
    if likelihood.responses:
        of_frfs = distinct.evaluate(
            lambda theta: np.stack([term.terms(own) for term, own in problem.responses_at(theta)], axis=1)
        )
        one = of_frfs.shape[2] == 1
        terms[FRFS] = (dims[:2], of_frfs[..., 0]) if one else ((*dims[:2], "test_of_frfs"), of_frfs)
    # a pseudo-likelihood, or an error model of shapes alone, has no measurement noise of frequencies
    if likelihood.simulates:
        noise = generator(result.seed, NOISE_STREAM)
        drawn = {"frequency": problem.simulate_data(noise, hz, theta)}
        if problem.data.tests is not None:
            drawn[ONE_MORE_TEST] = problem.simulate_test(noise, hz, theta)
        if discrepant is not None:
            drawn[NEW_MEASUREMENT] = problem.simulate_data(noise, hz, theta, same_structure=True)
        predicted = {name: (dims, x.reshape(frequency.shape), hertz) for name, x in drawn.items()} | predicted
    observed: dict[str, tuple[object, ...]] = {
        "frequency": ("mode", np.asarray(problem.data.frequencies_hz, dtype=float), hertz)
    }
    if problem.data.tests is not None:
        observed["tests"] = (("test", "mode"), np.asarray(problem.data.tests.frequencies_hz), hertz)
    if len(problem.tests) > 1:
        names = [test.name for test in problem.tests]
        observed["of_test"] = ("mode", np.array([names[t] for t in problem.model.test_of_modes]))
    if likelihood.used is not None:
        observed["used"] = ("mode", np.array(problem.data.use))
    used = {"mode": likelihood.of_used(np.array(coordinates["mode"]))}
    return (
        {
            "log_likelihood": xr.Dataset(terms, coords=coordinates | used),
            "posterior_predictive": xr.Dataset(predicted, coords=coordinates),
            "observed_data": xr.Dataset(observed, coords={"mode": coordinates["mode"]}),
        }
        | misfit_group(problem, squares, coordinates | used)
        | quantities_group(problem, result.posterior.position, _sample_coordinates(result.posterior.position))
        | frf_groups(problem, result.posterior.position, generator(result.seed, FRF_STREAM))
    )


def _groups_of_tests(result: RunResult, problem: UpdatingProblem, predictions: bool) -> dict[str, xr.Dataset]:
    """Return the trace groups of a problem with several tests, keyed by name; see `to_trace`."""
    import xarray as xr

    from fmu.analysis.fit.populations import GROUP, population_group
    from fmu.analysis.fit.residual_scores import residual_group
    from fmu.posterior.joint.joint_problem import simulate_next_test

    position = result.posterior.position
    coordinates = _sample_coordinates(position)
    theta = position.reshape(-1, position.shape[-1])
    structural = theta[:, : problem.n_structural]
    values = evaluate_in_parts(problem.values, theta).reshape(*position.shape[:2], len(problem.tests), -1)
    variables = {
        p.name: (("chain", "draw", "test"), values[..., j], {"units": p.unit})
        for j, p in enumerate(problem.layout.structural)
    }
    names = [test.name for test in problem.tests]
    found = {"tests": xr.Dataset(variables, coords=coordinates | {"test": names})}
    if problem.is_hierarchical:
        found[GROUP] = population_group(problem, structural, position.shape[:2], coordinates)
    states = problem.layout.states
    if states:
        losses = problem.layout.losses(structural).reshape(*position.shape[:2], len(states), -1)
        lost = {n: (("chain", "draw", "state"), losses[..., j]) for j, n in enumerate(problem.layout.by_state)}
        attributes = {"reference": problem.layout.reference}
        found["loss"] = xr.Dataset(lost, coords=coordinates | {"state": list(states)}, attrs=attributes)
    by_date = problem.layout.by_date
    if by_date:
        losses = problem.layout.losses_by_test(structural).reshape(*values.shape[:3], len(by_date))
        lost = {name: (("chain", "draw", "test"), losses[..., j]) for j, name in enumerate(by_date)}
        found["loss_by_test"] = xr.Dataset(lost, coords=coordinates | {"test": names})
    found |= drawn_structure(problem) | (residual_group(problem, theta) if predictions else {})
    if predictions and problem.is_hierarchical and problem.likelihood.simulates:
        computed, measured = simulate_next_test(problem, generator(result.seed, NEXT_TEST_STREAM), theta)
        dims, shape = ("chain", "draw", "mode"), (*position.shape[:2], computed.shape[1])
        predicted = {
            "frequency": (dims, measured.reshape(shape), {"units": "Hz"}),
            "model_frequency": (dims, computed.reshape(shape), {"units": "Hz"}),
        }
        modes = {"mode": list(problem.tests[0].data.labels)}
        found["next_test"] = xr.Dataset(predicted, coords=coordinates | modes)
    return found


def _stack_terms(terms: FloatArray, squares: FloatArray) -> FloatArray:
    """Stack log-likelihood terms (n, n_modes) and squared residuals (n, n_kinds, n_modes) along axis 1."""
    return np.concatenate([terms[:, None], squares], axis=1)
