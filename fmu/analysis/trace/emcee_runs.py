"""Read the stored steps of an emcee ensemble from a sampler, a backend or an HDF file."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmu.numbers import share
from fmu.plain_data import mapping_in
from fmu.types import BoolArray, FloatArray

_THINNED = 1.02
"""Steps are missing if moves exceed this factor times the accepted proposals, by more than one per walker."""


@dataclass(frozen=True, eq=False)
class StoredEnsemble:
    """The stored steps of one emcee ensemble.

    Attributes
    ----------
    chain : ndarray, shape (steps, walkers, ndim)
    log_prob : ndarray, shape (steps, walkers)
    accepted : ndarray, shape (walkers,)
        Each walker's number of accepted proposals in the stored steps.
    blobs : ndarray, shape (steps, walkers, ...), or None
    names : tuple of str
        The sampler's ``parameter_names``; empty if it has none.
    moves : tuple of (str, float)
        Names and weights of the sampler's moves; empty if they are unknown.
    """

    chain: FloatArray
    log_prob: FloatArray
    accepted: FloatArray
    blobs: NDArray[Any] | None
    names: tuple[str, ...] = ()
    moves: tuple[tuple[str, float], ...] = ()

    @classmethod
    def read(cls, source: Any, hdf_name: str) -> StoredEnsemble:
        """Read the steps stored so far; `fmu.from_emcee` lists the errors raised."""
        backend, where = _backend(source, hdf_name)
        steps = int(backend.iteration) if backend.initialized else 0
        if steps < 1:
            raise ValueError(f"source: must hold at least one stored step (got none in {where})")
        try:
            blobs = backend.get_blobs()
            chain, log_prob, accepted = backend.get_chain(), backend.get_log_prob(), backend.accepted
        except (OSError, KeyError) as error:
            raise ValueError(f"source: must be complete (got {where}: {error})") from error
        return cls(
            np.asarray(chain[:steps]),
            np.asarray(log_prob[:steps]),
            np.array(accepted, dtype=float),
            None if blobs is None else np.asarray(blobs[:steps]),
            _parameter_names(getattr(source, "parameter_names", None)),
            _moves(source),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of walkers and number of parameters."""
        return self.chain.shape[1], self.chain.shape[2]

    def find_moves(self, thin_by: int) -> BoolArray | None:
        """Return a mask (steps, walkers) of the walkers that moved, or None if some steps were not stored.

        Steps are missing if `thin_by` exceeds 1. They are also missing if walkers moved clearly more often than
        emcee accepted proposals; this gives a warning. A walker moved in the first step if the number of its
        accepted proposals exceeds the number of its later moves.
        """
        changed = np.any(self.chain[1:] != self.chain[:-1], axis=2)
        if thin_by > 1:
            return None
        if changed.sum() > _THINNED * self.accepted.sum() + self.chain.shape[1]:
            accepted = self.accepted.sum() / (changed.size + changed.shape[1])
            warnings.warn(
                f"thin_by: must be that of run_mcmc, or too few evaluations are counted: walkers moved in "
                f"{share(float(changed.mean()))} of the stored steps, but emcee accepted {share(float(accepted))} "
                "of them (got 1)",
                stacklevel=4,
            )
            return None
        return np.concatenate([[self.accepted > changed.sum(axis=0)], changed])


def check_alike(ensembles: list[StoredEnsemble]) -> None:
    """Raise ValueError unless the ensembles agree in numbers of walkers and parameters, in names and in blobs.

    Blobs agree if they have the same type and shape.
    """
    first = ensembles[0]
    for k, ensemble in enumerate(ensembles):
        for what, one, other in (
            ("shape (walkers, parameters)", first.shape, ensemble.shape),
            ("parameter_names", first.names, ensemble.names),
            ("blobs", _kind(first.blobs), _kind(ensemble.blobs)),
        ):
            if one != other:
                raise ValueError(
                    f"source: all ensembles must have the {what} of the first, {one} (got {other} of ensemble {k})"
                )


def _kind(blobs: NDArray[Any] | None) -> str:
    return "none" if blobs is None else f"{blobs.dtype} of shape {blobs.shape[2:]}"


def _backend(source: Any, hdf_name: str) -> tuple[Any, str]:
    """Return the emcee backend of a source, and a text that says where it is.

    Raise FileNotFoundError, TypeError or ValueError unless there is a readable run.
    """
    from emcee.backends import Backend, HDFBackend

    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if not path.is_file():
            raise FileNotFoundError(f"source: must be a file of emcee's HDFBackend (no such file: {path})")
        return _require_steps(HDFBackend(os.fspath(path), name=hdf_name, read_only=True)), str(path)
    backend = getattr(source, "backend", source)
    if not isinstance(backend, Backend):
        raise TypeError(
            "source: must be an emcee.EnsembleSampler, one of its backends, the path of an HDF file, or a list of "
            f"these (got {type(source).__name__})"
        )
    if isinstance(backend, HDFBackend):
        return _require_steps(backend), str(backend.filename)
    return backend, f"this {type(source).__name__}"


def _require_steps(backend: Any) -> Any:
    """Return the HDF backend; raise ValueError unless its file contains the run."""
    try:
        with backend.open() as file:
            inside = sorted(file)
    except OSError as error:
        raise ValueError(
            f"source: must be a readable file of emcee's HDFBackend (got {backend.filename}: {error})"
        ) from error
    if backend.name not in inside:
        there = f"it holds {', '.join(inside)}" if inside else "it is empty"
        raise ValueError(f"hdf_name: must be a run in {backend.filename}; {there} (got {backend.name!r})")
    return backend


def _parameter_names(given: Any) -> tuple[str, ...]:
    """Return a sampler's ``parameter_names`` as a tuple, in the order of the parameters; empty if it has none.

    A name that covers several parameters is numbered: ``"k[0]"``, ``"k[1]"``.
    """
    if not given:
        return ()
    by_name = mapping_in(given)
    if by_name is None:
        return tuple(str(name) for name in given)
    found: dict[int, str] = {}
    for name, at in by_name.items():
        where = np.atleast_1d(np.asarray(at)).tolist()
        found |= {i: name if len(where) == 1 else f"{name}[{k}]" for k, i in enumerate(where)}
    return tuple(found[i] for i in sorted(found))


def _moves(source: Any) -> tuple[tuple[str, float], ...]:
    """Return the names and weights of a sampler's moves, or an empty tuple if they are unknown."""
    pairs = zip(getattr(source, "_moves", ()), getattr(source, "_weights", ()), strict=False)
    return tuple((type(move).__name__, float(weight)) for move, weight in pairs)
