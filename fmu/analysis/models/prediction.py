"""Predict frequencies of unmeasured modes, or of a modified structure, including the model discrepancy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from annotated_types import Ge

from fmu.analysis.convergence.diagnostics import interval_columns
from fmu.analysis.trace.densities import discrepant_likelihood
from fmu.analysis.trace.reading import check_trace, parameter_draws, parameter_names
from fmu.arguments import ArgumentError, Count, Seed, check_arguments
from fmu.fem.modes.changes import Change, changed_model
from fmu.fem.pairing.paired_structure import structure_of
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from fmu.posterior.problem import UpdatingProblem
from fmu.tables import data_frame
from fmu.types import FloatArray, Positive

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@check_arguments
def predict_modes(
    trace: xr.DataTree,
    problem: UpdatingProblem,
    modes: Count,
    *,
    change: Change | None = None,
    factors: Mapping[str, Positive] | None = None,
    test: str | None = None,
    draws: Annotated[int, Ge(2)] = 400,
    seed: Seed = 1,
) -> pd.DataFrame:
    """Predict the lowest frequencies of a structure, measured or not, in its present or a modified state.

    The model is solved at posterior draws. With a discrepancy, each mode gets its own error, as an unmeasured mode
    would. In each mode the parameters scatter by τ (kind "embedded"), or the frequency has an error with standard
    deviation σ (kind "modes"). The data inform only the part of this error that all modes share. For the measured
    modes of an unmodified structure, `fmu.analysis.prediction.predict_frequencies` is better, because it uses the
    errors of these modes given the data.

    Parameters
    ----------
    trace : xarray.DataTree
        Draws from the posterior of `problem`.
    problem : UpdatingProblem
        A problem whose model has matrices.
    modes : int
        Number of modes, from the lowest; rigid-body motions count.
    change : Change, optional
        Masses and springs that are added to those of the test.
    factors : mapping of str to float, optional
        Factors on parameters that are not known in the test, keyed by parameter: 0.8 for a stiffness that has lost
        20 %.
    test : str, optional
        Name of the test whose parameters the structure has, such as a test of the damaged state, with its added
        masses and springs and its known parameters; required if there are several tests.
    draws : int
        Largest number of draws used, evenly spaced over the trace. Each takes a solve of the full model. Draws at
        which it fails are left out.
    seed : int
        Seed of the model errors.

    Returns
    -------
    pandas.DataFrame
        One row per mode, Hz: ``mean``, ``sd``, ``eti90_lb`` and ``eti90_ub`` of the frequency, including model
        discrepancy, and ``model_sd``, ``model_eti90_lb`` and ``model_eti90_ub`` without it. Measurement noise is
        not included.

    Raises
    ------
    ValueError
        If the trace has other parameters, the model has no matrices or fewer modes, or a parameter, place or test
        does not exist.
    """
    check_trace(trace)
    if parameter_names(trace) != problem.names:
        raise ArgumentError("trace", "must be of the problem (its parameters have other names)")
    theta = parameter_draws(trace).reshape(-1, problem.ndim)
    theta = theta[np.unique(np.linspace(0, len(theta) - 1, min(draws, len(theta))).astype(int))]
    t = _index_of(problem, test)
    values = problem.values(theta)[:, t] * _factors(problem, t, factors or {})
    f, J = _solve(problem, t, values, modes, change or Change())
    solved = np.isfinite(f).all(axis=1)
    theta, values, f, J = theta[solved], values[solved], f[solved], J[solved]
    whole, likelihood = f, discrepant_likelihood(problem)
    if likelihood is not None:
        whole = _with_errors(problem, likelihood, theta, values, f, J, np.random.default_rng(seed))
    columns: dict[str, FloatArray] = {"mean": whole.mean(axis=0)}
    for prefix, x in (("", whole), ("model_", f)):
        columns[f"{prefix}sd"] = x.std(axis=0, ddof=1)
        for name, q in zip(interval_columns(0.9), (0.05, 0.95), strict=True):
            columns[f"{prefix}{name}"] = np.quantile(x, q, axis=0)
    return data_frame(columns, "mode", np.arange(1, modes + 1))


def _index_of(problem: UpdatingProblem, test: str | None) -> int:
    """Return the index of the test with a given name, or 0 for the only test if the name is None.

    Raise ValueError for an unknown name, or if the name is None and there are several tests.
    """
    names = [one.name for one in problem.tests]
    if test is None and len(names) == 1:
        return 0
    if test not in names:
        raise ArgumentError("test", f"must be of {', '.join(map(repr, names))}", repr(test))
    return names.index(test)


def _factors(problem: UpdatingProblem, test: int, factors: Mapping[str, float]) -> FloatArray:
    """Return the factor on each structural parameter, (p,). Raise ValueError unless all can change in the test."""
    names = [p.name for p in problem.layout.structural]
    unknown = [names[j] for j in problem.model.in_test(test)[1]]
    for name in factors:
        if name not in unknown:
            raise ArgumentError("factors", f"must be of {', '.join(unknown)}", repr(name))
    return np.array([factors.get(name, 1.0) for name in names])


def _solve(
    problem: UpdatingProblem, test: int, values: FloatArray, modes: int, change: Change
) -> tuple[FloatArray, FloatArray]:
    """Return the lowest frequencies in Hz, (n, modes), at parameters (n, p), and their gradients, (n, modes, p).

    The structure is that of the test with this index. The gradient with respect to parameters that are known in it
    is zero. Raise ValueError if the model has no matrices or fewer modes, or if the change does not suit it.
    """
    model, own = problem.model.in_test(test)
    paired = structure_of(model)
    if paired is None:
        raise ArgumentError("problem", "must have a model with matrices", type(problem.model.truth).__name__)
    structure = changed_model(paired.structure, change.masses, change.springs)
    if modes > structure.n_dof:
        raise ArgumentError("modes", f"must be at most the {structure.n_dof} of the model", str(modes))
    data = ModalData(np.arange(1.0, modes + 1.0), numbers=tuple(range(1, modes + 1)))
    parameters = [replace(problem.layout.structural[j], updated=True) for j in own]
    full = UpdatingProblem(structure, data, parameters, pairing="index").model
    f, slopes = full.frequencies_and_gradient(values[:, own])
    J = np.zeros((*f.shape, values.shape[1]))
    J[:, :, own] = slopes
    return f, J


def _with_errors(
    problem: UpdatingProblem,
    likelihood: DiscrepantLikelihood,
    theta: FloatArray,
    values: FloatArray,
    f: FloatArray,
    J: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Add random model errors to the frequencies f (n, m), drawn as for modes that were not measured."""
    at = problem.layout.of_model(theta)
    noise = theta[:, problem.n_structural :]
    of_modes = np.broadcast_to(values[:, None], (*f.shape, values.shape[1]))
    own, common = likelihood.errors.in_hz(J, f.mean(axis=0), of_modes, noise)
    used = np.arange(problem.data.n_modes) if likelihood.used is None else likelihood.used
    _, _, _, w, of_w = likelihood.errors_given_data(likelihood.observed(at), at, used)
    w = w + np.einsum("ncd,nd->nc", np.linalg.cholesky(of_w), rng.standard_normal(w.shape))
    z = rng.standard_normal(own.shape)
    return np.asarray(f - np.sum(own * z, axis=2) - np.einsum("nmc,nc->nm", common, w))
