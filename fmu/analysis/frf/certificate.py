"""Errors of the reduced model's FRFs at some draws of a run."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.certificate import CertificateWarning
from fmu.analysis.trace.reading import parameter_draws
from fmu.fem.frf.confirming import FRFCertificate, confirm
from fmu.posterior.problem import UpdatingProblem

if TYPE_CHECKING:
    import xarray as xr

_DRAWS = 4


def certify_frfs(trace: xr.DataTree, problem: UpdatingProblem, draws: int = _DRAWS) -> FRFCertificate | None:
    """Return the reduced model's FRF errors at some draws, or None if there are no FRFs or no reduced model.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : UpdatingProblem
        The problem that was sampled.
    draws : int
        Number of draws, chosen at random with the trace's seed.

    Warns
    -----
    CertificateWarning
        If the errors exceed their tolerance.
    """
    if not problem.likelihood.responses:
        return None
    theta = parameter_draws(trace).reshape(-1, problem.ndim)
    rng = np.random.default_rng(int(trace.attrs["seed"]))
    some = theta[rng.permutation(len(theta))[:draws]]
    each = [confirm(term.model, *term.split(own)) for term, own in problem.responses_at(some)]
    found = FRFCertificate.worst(one for one in each if one is not None)
    if found is not None and not found.ok:
        warnings.warn(found.sentence(), CertificateWarning, stacklevel=2)
    return found
