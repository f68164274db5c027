"""Known changes to a structure between tests: added masses and springs, and parameters with known values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError, Place, check_arguments
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term, merge_terms, monomial
from fmu.types import FloatArray

_TRANSLATIONS = ("x", "y", "z")


@check_arguments
@dataclass(frozen=True)
class Change:
    """A known change to the structure for one additional test.

    Attributes
    ----------
    masses : mapping of place to float, kg
        Added point masses; a negative value is a mass that was removed.
    springs : mapping of (place, direction) to float, N/m or N·m/rad
        Added springs to the ground, such as a support; a negative value is a spring that was removed.

    Raises
    ------
    ValueError
        If a mass or a stiffness is not a finite number, or a place is neither a number nor a name.
    """

    masses: Mapping[Place, float] = field(default_factory=dict)
    springs: Mapping[tuple[Place, str], float] = field(default_factory=dict)


def changed_model(
    model: SeparableModel,
    masses: Mapping[Any, float] | None = None,
    springs: Mapping[tuple[Any, str], float] | None = None,
    known: Mapping[int, float] | None = None,
) -> SeparableModel:
    """Return a new model with masses and springs added, and some parameters replaced by known values.

    Parameters
    ----------
    model : SeparableModel
    masses : mapping of place to float, kg
        Point masses without rotary inertia, which move with a node or with one of ``model.arms``. A negative mass
        is a mass that was removed.
    springs : mapping of (place, direction) to float, N/m or N·m/rad
        Springs to the ground; a negative stiffness is a spring that was removed.
    known : mapping of int to float
        Known parameter values by index (from 0); the new model does not have these parameters.

    Returns
    -------
    SeparableModel

    Raises
    ------
    ValueError
        If a mass is at a place that cannot translate, a spring is in a direction that is not free, no parameter
        remains, or a term is not finite at the known values.
    """
    K_terms, M_terms = list(model.K_terms), list(model.M_terms)
    constant = (0.0,) * model.n_parameters
    for place, mass in (masses or {}).items():
        seen = [(place, d) for d in _TRANSLATIONS if model.sees((place, d))]
        if not seen:
            raise ArgumentError(f"masses.{place}", "must be a place that is free to move", repr(place))
        M_terms.append(Term(_along(model.observation(seen), mass), constant))
    for (place, direction), stiffness in (springs or {}).items():
        if not model.sees((place, direction)):
            raise ArgumentError(
                f"springs.{place}",
                "must be a place and a direction that are free to move",
                f"{place!r}, {direction!r}",
            )
        K_terms.append(Term(_along(model.observation([(place, direction)]), stiffness), constant))
    kept = [j for j in range(model.n_parameters) if j not in (known or {})]
    if not kept:
        raise ArgumentError("known", "must leave a parameter that is uncertain", f"all {model.n_parameters}")
    if known:
        at = np.ones((1, model.n_parameters))
        at[0, list(known)] = list(known.values())
        K_terms, M_terms = (_without(terms, at, kept) for terms in (K_terms, M_terms))
    other = SeparableModel(
        merge_terms(K_terms),
        merge_terms(M_terms),
        model.dofs,
        model.geometry,
        model.arms,
        model.ties,
        model.motions,
    )
    other.notes, other.place_names = model.notes, model.place_names
    other.picture = model.picture and model.picture.of(kept)
    if model.names is not None:
        other.names = tuple(model.names[j] for j in kept)
    return other


def _along(rows: sp.csr_array, size: float) -> sp.csr_array:
    """Return the matrix size · RᵀR of a point mass (kg) or of a spring (N/m or N·m/rad).

    The `rows` R map displacements of the degrees of freedom to the motion of the mass or of the spring's end.
    """
    return sp.csr_array(size * (rows.T @ rows))


def _without(terms: list[Term], at: FloatArray, kept: list[int]) -> list[Term]:
    """Return terms that depend only on the parameters in `kept`.

    All other parameters are fixed at their values in `at` (1, n_parameters).
    """
    gone = [j for j in range(at.shape[1]) if j not in kept]
    found = []
    for term in terms:
        coefficient = float(monomial(at[:, gone], [term.powers[j] for j in gone])[0])
        found.append(Term(term.matrix * coefficient, tuple(term.powers[j] for j in kept)))
    return found
