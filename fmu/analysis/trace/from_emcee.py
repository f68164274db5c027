"""Convert runs of plain emcee to traces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.certificate import certify
from fmu.analysis.convergence.diagnosis import with_maxima
from fmu.analysis.identifiability import with_identifiability
from fmu.analysis.pairing_changes import with_pairing
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.trace.densities import is_updating, names_of
from fmu.analysis.trace.emcee_runs import StoredEnsemble, check_alike
from fmu.analysis.trace.modal_states import with_modes
from fmu.analysis.trace.reading import IMPORTED, parameter_names, with_group
from fmu.arguments import as_list, check_arguments
from fmu.numbers import typed
from fmu.posterior.parameters import require_name
from fmu.samplers.loop.record import Draws, RunResult
from fmu.samplers.settings import whole_number
from fmu.types import FloatArray, IntArray, LogDensity

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima

GROUP, BLOBS = "emcee", "blobs"
"""Names of the trace groups for emcee's statistics and for its blobs."""
_CHECKED = 5
"""Number of draws at which the stored log-probability is compared with the problem's."""
_SLACK = 1e-6
"""Largest relative difference (absolute for values below 1) that rounding on another processor may cause."""


@check_arguments
def from_emcee(
    source: Any,
    problem: LogDensity | None = None,
    *,
    names: Sequence[str] | None = None,
    discard: int | Sequence[int] = 0,
    thin: int = 1,
    thin_by: int = 1,
    hdf_name: str = "mcmc",
    blob_names: Sequence[str] | None = None,
    maxima: Maxima | None = None,
) -> xr.DataTree:
    """Convert plain emcee runs to a trace for `fmu.summary`, `fmu.diagnose` and all other analyses.

    Each ensemble becomes a chain of the trace. With fewer than four ensembles, the verdict states that separate
    modes cannot be excluded. A single ensemble has no R-hat; its verdict depends on autocorrelation times and on
    how well the walkers mix.

    Parameters
    ----------
    source : emcee.EnsembleSampler, emcee.backends.Backend, path-like, or a list of these
        The ensembles; a path points to an HDF file. The steps stored so far are read, also from a run that was
        interrupted, is still running, or was resumed.
    problem : UpdatingProblem or LogDensity, optional
        The density that was sampled. It supplies parameter names, units and bounds, and the groups for model, data
        and predictions. Leave it out if another log-probability was sampled, such as one with your own prior.
    names : sequence of str, optional
        Parameter names. Defaults to the problem's names, then to the sampler's ``parameter_names``, then to
        ``x0``, ``x1``, ...
    discard : int or sequence of int
        Number of stored steps at the beginning that are warm-up, as in ``sampler.get_chain``; one number, or one
        for each ensemble. If different numbers of steps are left, the ensembles are aligned at their ends, and
        more steps of the longer ensembles are discarded. The trace has the same number of warm-up steps for all.
    thin : int
        Keep only every `thin`-th stored step, as in ``sampler.get_chain``.
    thin_by : int
        The ``thin_by`` of ``run_mcmc``. Backends do not store it; it is needed to count evaluations.
    hdf_name : str
        Name of the run within an HDF file.
    blob_names : sequence of str, optional
        Names for unnamed blobs: one name for all, or one for each column. Defaults to ``blobs``.
    maxima : Maxima, optional
        Result of `fmu.find_map`. It is stored in the trace, and every verdict on the trace uses it.

    Returns
    -------
    xarray.DataTree
        The groups of `fmu.analysis.trace.conversion.to_trace`; for an updating problem also ``modes`` and
        ``pairing`` and, unless it is hierarchical or uses the modal residual, ``identifiability``, as from
        `fmu.sample`. A blob with the problem's frequencies becomes ``model_frequency`` of
        ``posterior_predictive``, so that the frequencies are not computed again; other blobs are in the group
        ``blobs``. The group ``emcee`` has ``acceptance_fraction`` (chain, walker) of all stored steps;
        ``autocorrelation_time`` (chain, parameter) by emcee's own function, in retained steps; ``stored`` and
        ``discard`` (chain). ``n_solves`` counts one evaluation per walker and step, and one at the start.
        ``accepted`` says whether a walker moved in a stored step, or is the walker's acceptance fraction if not
        all steps were stored. Wall times are unknown, and therefore NaN.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If there is no ensemble, no steps are stored, a file cannot be read or has no run `hdf_name`, ensembles
        differ in size, names or blobs, too few steps are left, names do not fit the chain, the blobs or the
        problem, names or blobs cannot be stored, a number is out of range, or the stored log-probabilities are
        never finite or differ from those of `problem` at five draws.
    TypeError
        If `source` is none of the types above.

    Warns
    -----
    UserWarning
        If walkers moved more often than emcee accepted proposals, so that not all steps were stored.
    """
    sources = as_list(source)
    if not sources:
        raise ValueError("source: must hold at least one ensemble (got none)")
    whole_number("thin_by", thin_by, 1)
    ensembles = [StoredEnsemble.read(one, hdf_name) for one in sources]
    check_alike(ensembles)
    kept = Kept.of(ensembles, _numbers(discard, len(ensembles)), whole_number("thin", thin, 1))
    named = _names(names, problem, ensembles)
    result = _result(ensembles, kept, thin_by)
    blobs = _blobs(ensembles, kept, blob_names)
    # numbers of a float32 backend are rounded
    precision = max(_SLACK, float(np.sqrt(np.finfo(ensembles[0].chain.dtype).eps)))
    frequency = None if problem is None else _check_log_prob(result.posterior, blobs, problem, precision)
    density: Any = _Unknown(named) if problem is None else problem
    trace = to_trace(result, density, frequency=frequency)
    trace.attrs |= {IMPORTED: "emcee", "complete": 1}
    trace = with_group(trace, GROUP, _count_evaluations(ensembles, kept, trace))
    if blobs:
        trace = with_group(trace, BLOBS, _dataset(blobs, trace))
    if maxima is not None:
        trace = with_maxima(trace, maxima)
    return _with_structure(trace, problem, maxima) if is_updating(problem) else trace


class _Unknown:
    """Placeholder for an unknown density, with parameter names and infinite bounds."""

    name = "emcee"

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.ndim = names, len(names)
        self.lower, self.upper = np.full(self.ndim, -np.inf), np.full(self.ndim, np.inf)

    def configuration(self) -> dict[str, Any]:
        """Return the density's name and parameters, for the trace's configuration."""
        return {"density": "emcee", "names": list(self.names)}


@dataclass(frozen=True)
class Kept:
    """The stored steps used as warm-up and as draws, the same number for each ensemble.

    Attributes
    ----------
    draws, warmup : tuple of ndarray of int, shape (n,)
        Indices of the stored steps of each ensemble. Warm-up steps are not thinned.
    discard : tuple of int
        Number of stored steps discarded at the beginning of each ensemble.
    thin : int
    """

    draws: tuple[IntArray, ...]
    warmup: tuple[IntArray, ...]
    discard: tuple[int, ...]
    thin: int

    @classmethod
    def of(cls, ensembles: list[StoredEnsemble], discard: list[int], thin: int) -> Kept:
        """Choose the same number of last steps in each ensemble; raise ValueError if one has no draw left."""
        each = []
        for ensemble, skipped in zip(ensembles, discard, strict=True):
            stored = len(ensemble.chain)
            each.append(np.arange(skipped + thin - 1, stored, thin))
            if not len(each[-1]):
                raise ValueError(
                    f"discard: must leave at least {thin} of {stored} stored steps for one draw (got {skipped})"
                )
        n = min(len(at) for at in each)
        draws = tuple(at[len(at) - n :] for at in each)
        first = tuple(int(at[0]) - thin + 1 for at in draws)
        return cls(draws, tuple(np.arange(stop - min(first), stop) for stop in first), first, thin)

    def evaluations(self, k: int, stored: int, thin_by: int) -> tuple[IntArray, IntArray]:
        """Return each walker's evaluation counts in ensemble `k`, for its warm-up steps (n,) and its draws (n,).

        They add up to the cost of the whole run: one evaluation per step, and one at the start.
        """
        at = np.concatenate([self.warmup[k], self.draws[k]])
        until = thin_by * (at + 1) + 1
        until[-1] = thin_by * stored + 1
        each = np.diff(until, prepend=0)
        return each[: len(self.warmup[k])], each[len(self.warmup[k]) :]


def _names(names: Sequence[str] | None, problem: Any, ensembles: list[StoredEnsemble]) -> tuple[str, ...]:
    """Return the parameter names.

    Raise ValueError if `names` or the sampler's names differ from the problem's, if their number does not fit the
    stored chain, or if a name occurs twice or is not valid.
    """
    ndim, of_sampler = ensembles[0].shape[1], ensembles[0].names
    of_problem = () if problem is None else names_of(problem)
    found = (() if names is None else tuple(names)) or of_problem or of_sampler
    found = found or tuple(f"x{i}" for i in range(ndim))
    if len(found) != ndim:
        whose = "problem" if found == of_problem else "names"
        raise ValueError(f"{whose}: must have {ndim} parameters, as the stored chain (got {len(found)}: {found})")
    for what, other in (("names", found), ("parameter_names of the sampler", of_sampler)):
        if of_problem and other and other != of_problem:
            raise ValueError(f"{what}: must be those of the problem, {list(of_problem)} (got {list(other)})")
    if len(set(found)) < ndim:
        raise ValueError(f"names: must differ from each other (got {list(found)})")
    for name in found:
        require_name(name)
    return found


def _numbers(discard: int | Sequence[int], n: int) -> list[int]:
    """Return the number of steps to discard from each of `n` ensembles.

    Raise ValueError if `discard` is neither one number nor one for each ensemble, or if a number is negative.
    """
    each = list(discard) if isinstance(discard, Sequence | np.ndarray) else [discard] * n
    if len(each) != n:
        raise ValueError(f"discard: must be one number, or one for each of {n} ensembles (got {len(each)})")
    return [whole_number("discard", one, 0) for one in each]


def _result(ensembles: list[StoredEnsemble], kept: Kept, thin_by: int) -> RunResult:
    """Return the ensembles as a `RunResult`, with step-major draws and the cost of all evaluations."""
    walkers = ensembles[0].shape[0]
    accepted: list[NDArray[Any]] = []
    for ensemble in ensembles:
        moved = ensemble.find_moves(thin_by)
        share = np.broadcast_to(ensemble.accepted / len(ensemble.chain), ensemble.log_prob.shape)
        accepted.append(share if moved is None else moved)
    costs = [kept.evaluations(k, len(e.chain), thin_by) for k, e in enumerate(ensembles)]

    def draws(at: tuple[IntArray, ...], phase: int) -> Draws:
        def of(stored: Sequence[NDArray[Any]]) -> NDArray[Any]:
            return _flat([one[i] for one, i in zip(stored, at, strict=True)])

        n_solves = _flat([np.repeat(cost[phase][:, None], walkers, axis=1) for cost in costs])
        lp = of([e.log_prob for e in ensembles]).astype(float)
        stats = {"lp": lp, "accepted": of(accepted), "n_solves": n_solves, "n_gradients": np.zeros_like(n_solves)}
        return Draws(of([e.chain for e in ensembles]).astype(float), stats)

    settings = {
        "moves": [list(move) for move in ensembles[0].moves] or None,
        "stored": [len(e.chain) for e in ensembles],
        "discard": list(kept.discard),
        "thin": kept.thin,
        "thin_by": thin_by,
    }
    return RunResult(
        warmup=draws(kept.warmup, 0),
        posterior=draws(kept.draws, 1),
        sampler="emcee",
        settings=settings,
        seed=0,  # seed of the noise of predictions; emcee's seed is unknown
        walkers=walkers,
        draws=len(kept.draws[0]),
        warmup_draws=len(kept.warmup[0]),
        chains=len(ensembles),
        init="array",
        wall_s=np.nan,
        warmup_wall_s=np.nan,
    )


def _flat(each: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Stack arrays (steps, walkers, ...), one per ensemble, as (ensembles, steps * walkers, ...), step-major."""
    stacked = np.stack(each)
    return stacked.reshape(len(stacked), -1, *stacked.shape[3:])


def _blobs(ensembles: list[StoredEnsemble], kept: Kept, names: Sequence[str] | None) -> dict[str, NDArray[Any]]:
    """Return the blobs at the draws, keyed by name, each of shape (ensembles, draws, ...).

    The dict is empty if none are stored. Raise ValueError if `names` do not fit the blobs or are not valid, or if
    a blob of Python objects cannot be converted to numbers.
    """
    if ensembles[0].blobs is None:
        if names is not None:
            raise ValueError(f"blob_names: need blobs (got {list(names)}, and none are stored)")
        return {}
    stored = _flat([e.blobs[at] for e, at in zip(ensembles, kept.draws, strict=True) if e.blobs is not None])
    if stored.dtype.names:
        found = {name: stored[name] for name in stored.dtype.names}
    elif names is None or len(names) == 1:
        found = {"blobs" if names is None else names[0]: stored}
    else:
        columns = stored.shape[2] if stored.ndim > 2 else 1
        if len(names) != columns:
            raise ValueError(f"blob_names: must be one, or one for each of {columns} columns (got {len(names)})")
        found = {name: stored[:, :, k] for k, name in enumerate(names)}
    for name, values in found.items():
        if values.dtype == object:  # emcee stores blobs of unknown type in this way
            try:
                found[name] = np.array(values.tolist(), dtype=float)
            except (TypeError, ValueError):
                raise ValueError(
                    f"blobs: must be numbers, equally many at every draw (got {type(values.flat[0]).__name__} in "
                    f"{name!r}); set blobs_dtype of emcee.EnsembleSampler"
                ) from None
        require_name(name)
    return found


def _check_log_prob(
    draws: Draws, blobs: dict[str, NDArray[Any]], problem: Any, precision: float
) -> FloatArray | None:
    """Check the stored log-probability against the problem at five draws, and take its frequencies from the blobs.

    Return the frequencies (chains, draws, n_modes) and remove them from `blobs`. Return None if `blobs` does not
    contain them, or if the problem is a plain log-density. Raise ValueError if no stored log-probability is
    finite, or if one differs from the computed one by more than the relative `precision` plus the tolerance of a
    reduced model.
    """
    theta = draws.position.reshape(-1, draws.position.shape[2])
    stored = draws.stats["lp"].ravel()
    finite = np.flatnonzero(np.isfinite(stored))
    if not len(finite):
        raise ValueError("source: must have draws with finite log-probabilities (got none)")
    at = finite[np.unique(np.linspace(0, len(finite) - 1, _CHECKED).astype(int))]
    computed = np.asarray(problem.log_prob(theta[at]), dtype=float)
    off = np.abs(stored[at] - computed)
    allowed = precision * np.maximum(1.0, np.abs(computed))
    tolerance = getattr(problem, "tolerance", None)
    if tolerance is not None:  # the run may have used the full model
        allowed = allowed + tolerance.log_prob
    if not np.all(off <= allowed):
        worst = int(np.argmax(np.where(np.isnan(off), np.inf, off)))
        raise ValueError(
            f"problem: must have the stored log-probabilities; at draw {typed(at[worst])} "
            f"{typed(stored[at[worst]])} is stored (got {typed(computed[worst])} of the problem); "
            "leave the problem out and give names if the run had another prior"
        )
    if not is_updating(problem):
        return None
    hz = np.asarray(problem.frequencies(theta[at]))
    for name, values in blobs.items():
        is_like = values.shape[2:] == hz.shape[1:]
        if is_like and np.allclose(values.reshape(-1, *hz.shape[1:])[at], hz, rtol=precision, atol=0.0):
            return np.asarray(blobs.pop(name), dtype=float)
    return None


def _count_evaluations(ensembles: list[StoredEnsemble], kept: Kept, trace: xr.DataTree) -> xr.Dataset:
    """Return a dataset with emcee's acceptance fractions, autocorrelation times and step counts."""
    import xarray as xr
    from emcee.autocorr import integrated_time

    times = []
    for ensemble, at in zip(ensembles, kept.draws, strict=True):
        with np.errstate(invalid="ignore", divide="ignore"):  # NaN where a walker does not move
            times.append(integrated_time(ensemble.chain[at], tol=0))
    variables = {
        "acceptance_fraction": (("chain", "walker"), np.array([e.accepted / len(e.chain) for e in ensembles])),
        "autocorrelation_time": (("chain", "parameter"), np.array(times)),
        "stored": ("chain", np.array([len(e.chain) for e in ensembles])),
        "discard": ("chain", np.array(kept.discard)),
    }
    return xr.Dataset(variables, coords={"parameter": list(parameter_names(trace))})


def _dataset(blobs: Mapping[str, NDArray[Any]], trace: xr.DataTree) -> xr.Dataset:
    import xarray as xr

    variables = {
        name: (("chain", "draw", *(f"{name}_dim_{k}" for k in range(values.ndim - 2))), values)
        for name, values in blobs.items()
    }
    return xr.Dataset(variables, coords={name: trace["posterior"][name] for name in ("chain", "draw")})


def _with_structure(trace: xr.DataTree, problem: Any, maxima: Maxima | None) -> xr.DataTree:
    """Return the trace with the model's certificate, modes and pairing added.

    Identifiability is added too, unless the problem is hierarchical or uses the modal residual.
    """
    certificate = certify(trace, problem, full_solves=problem.model.full_solves)
    trace.attrs |= {} if certificate is None else certificate.attributes()
    trace = with_pairing(with_modes(trace, problem, maxima), problem)
    if problem.is_hierarchical or not problem.likelihood.of_modes:
        return trace
    return with_identifiability(trace, problem, maxima)
