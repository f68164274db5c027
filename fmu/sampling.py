"""Sampling a problem, from the sampler's name to the trace."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

    from fmu.samplers.kernel import LogDensity, Sampler
    from fmu.samplers.run import Progress

SAMPLERS = ("mh", "slice", "hmc", "emcee")
"""The names of the samplers, without importing them."""


def sample(
    problem: LogDensity,
    sampler: str | Sampler = "hmc",
    *,
    draws: int = 1000,
    warmup: int = 1000,
    chains: int = 4,
    seed: int = 1,
    init: str | ArrayLike = "prior",
    progress: Progress | None = None,
) -> xr.DataTree:
    """Draw from the posterior of a problem, or from any log-density.

    The same problem, sampler, numbers and seed give the same draws, bit for bit.

    Parameters
    ----------
    problem : LogDensity
        An `UpdatingProblem`, or anything with ``ndim``, ``lower``, ``upper``, ``log_prob`` and
        ``log_prob_and_grad``.
    sampler : str or Sampler
        ``"mh"``, ``"slice"``, ``"hmc"`` or ``"emcee"`` with their default settings, or a settings object such as
        ``fmu.HamiltonianMonteCarlo(gradient="central-difference")``.
    draws, warmup : int
        Steps kept, and steps before them. An ensemble draws as many vectors a step as it has walkers.
    chains : int
        Independent chains; of an ensemble sampler, independent ensembles.
    seed : int
    init : {"prior", "start"} or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        Where the chains start: drawn from the prior, at ``problem.start``, or where the array says (SI units).
    progress : callable, optional
        Called after every step as ``progress(phase, done, total, info)``.

    Returns
    -------
    xarray.DataTree
        The trace, see `fmu.analysis.trace.to_trace`; its attributes include the certificate of the reduced model
        where there is one, see `fmu.analysis.certificate.certify`.

    Raises
    ------
    ValueError
        If the sampler's name is unknown, a number is out of range, or a chain would start outside the bounds or
        where the log-probability is not finite.
    """
    import numpy as np

    from fmu.analysis.certificate import certify
    from fmu.analysis.trace import to_trace
    from fmu.samplers import named, run

    settings: Any = named(sampler) if isinstance(sampler, str) else sampler
    if not (hasattr(settings, "bind") and hasattr(settings, "walkers")):
        raise ValueError(
            f"sampler: must be one of {', '.join(SAMPLERS)}, or a settings object such as fmu.Slice() "
            f"(got {sampler!r})"
        )
    start = None if isinstance(init, str) else np.asarray(init, dtype=float)
    full_solves = getattr(getattr(problem, "model", None), "full_solves", 0)
    result = run(
        problem,
        settings,
        draws=draws,
        warmup=warmup,
        chains=chains,
        seed=seed,
        init=init if start is None else start,
        progress=progress,
    )
    trace = to_trace(result, problem, start)
    trace.attrs.update(certify(trace, problem, full_solves=full_solves))
    return trace
