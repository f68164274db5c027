"""Compare models of the same data. Models that have no draws yet are sampled first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fmu.analysis.models.comparison import ModelComparison, compare_traces
from fmu.arguments import ArgumentError, Seed, check_arguments
from fmu.posterior.problem import UpdatingProblem
from fmu.sampling import sample
from fmu.types import Positive

if TYPE_CHECKING:
    import xarray as xr


@check_arguments
def compare_models(
    models: Mapping[str, UpdatingProblem | xr.DataTree],
    *,
    until_ess: Positive = 400.0,
    seed: Seed = 1,
) -> ModelComparison:
    """Compare models of the same data that differ in parameters, priors, structure or discrepancy.

    Parameters
    ----------
    models : mapping of str to UpdatingProblem or xarray.DataTree
        A problem is sampled with ``fmu.sample(problem, until_ess=until_ess, seed=seed)``; a trace is used as it
        is.
    until_ess : float
        Effective sample size that each sampled problem must reach.
    seed : int
        Seed of the sampling.

    Returns
    -------
    ModelComparison
        Its ``table`` is a `pandas.DataFrame` with one row per model, and its ``sentences`` interpret the table:

        - ``log_evidence``, ``error``: log-evidence and its standard error (from `fmu.evidence`, or from the masses
          of the maxima); NaN if unknown, for a reason that a sentence gives;
        - ``difference``: difference from the largest log-evidence;
        - ``probability``: posterior probability of the model, if all models with an evidence were equally probable
          before the test;
        - ``n_parameters``: effective number of parameters, including inferred standard deviations;
        - ``held_out``: number of modes that every model with a table of `fmu.leave_one_out` predicts from the
          other modes; 0 for a model without this table;
        - ``inside``: number of these modes that lie in their 90 % predictive intervals;
        - ``sum_z2``: Σ z² over these modes, where z is the prediction error in standard deviations;
        - ``elpd``, ``elpd_se``: log predictive density of these modes, and its standard error;
        - ``p``: probability that the residuals' χ² is larger if the model is right (`fmu.diagnose`), or NaN if
          this was not checked;
        - ``verdict``: whether the data contradict the model, in words;
        - ``converged``, ``wall_s``: whether the draws have converged, and the time they took in s, including
          warm-up.

    Raises
    ------
    ValueError
        If there are fewer than two models, or a trace does not come from an updating problem. Also if the models
        do not use the same quantities of the same measured data, or some have errors in Hz and others errors in
        relative eigenvalues: evidences of different data cannot be compared.

    References
    ----------
    Kass & Raftery (1995), *J. Am. Stat. Assoc.* 90, 773–795; Vehtari, Gelman & Gabry (2017), *Stat. Comput.* 27,
    1413–1432.
    """
    if len(models) < 2:  # before any of them is sampled
        raise ArgumentError("models", "must be two or more", len(models))
    traces = {
        name: sample(model, until_ess=until_ess, seed=seed) if isinstance(model, UpdatingProblem) else model
        for name, model in models.items()
    }
    return compare_traces(traces)
