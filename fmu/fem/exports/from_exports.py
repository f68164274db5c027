"""Recovery of K(θ) and M(θ) from matrices that a program exports at several parameter values.

An entry of an assembled matrix is a sum over elements. As a function of most properties, an entry of an element
matrix is a sum of powers. Young's modulus and density enter with power 1. A plate's thickness enters with power 1
(membrane, mass) and power 3 (bending, rotary inertia), and a solid element's thickness with powers 1, 0 and -1.
The matrices of a few exports therefore determine the terms K_k of

    K(θ) = Σ_k Π_j θ_j^(p_kj) K_k,    p_kj ∈ {-1, 0, 1, 2, 3},

by least squares, entry by entry. The powers belong to the smallest set of terms that reproduces every export. A
length or Poisson's ratio is refused as a parameter, because the entries are not sums of its powers from -1 to 3. A
term may contain several parameters, such as E and t of one plate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.exports.entries import Entries
from fmu.fem.exports.recovery import TOLD, Export, Recovery, recover
from fmu.fem.modes.eigensolver import SingularMassError, eigen
from fmu.fem.modes.modal import frequency_hz, is_rigid
from fmu.fem.modes.separable import Geometry, SeparableModel
from fmu.numbers import hertz, names_in_words, significant
from fmu.types import BoolArray, FloatArray

FREQUENCY_ROUNDING = 1e-6
"""Relative standard deviation of the lowest frequency above which rounding of the exports is reported."""
_RIGID = 6
_SAME_MOTION = 1e-6
"""Largest difference allowed between a weight and the same weight in the first export, relative to the largest
weight of the motion."""


@check_arguments
def from_exports(
    exports: Sequence[Export], bounds: Mapping[str, tuple[float, float]] | None = None
) -> SeparableModel:
    """Recover a structure as a function of its parameters, from matrices exported at several parameter values.

    Parameters
    ----------
    exports : sequence of Export
        The first export gives all parameters, in the order of theta. For each parameter, at least one other export
        that is not a check must change this parameter alone. An export with ``check=True`` that changes all
        parameters shows whether the powers are right.
    bounds : mapping of str to (float, float), optional
        Parameter bounds, used to bound the rounding error. Defaults to half and twice the values in the first
        export.

    Returns
    -------
    SeparableModel
        The model's `notes` state the recovered terms and their accuracy.

    Raises
    ------
    ValueError
        If there are fewer than two exports or too few to separate the terms; the first export is a check or gives
        no parameters; a parameter value is not finite, or is zero in the first export; another export names a
        parameter that the first does not give; a parameter is not changed alone by any export; an export has
        different degrees of freedom or a different geometry; a parameter changes nothing; or powers from -1 to 3
        do not reproduce an export. In the last case, the message names the entries.

    Examples
    --------
    ``fmu.from_exports([fmu.Export({"E": 7e10, "t": 3e-3}, fmu.read_model("plate.sti")), fmu.Export({"E": 8e10},
    fmu.read_model("plate-E.sti")), …])``
    """
    names, values = _points(exports)
    _on_one_mesh(exports)
    first = values[0]
    ends = _limits(bounds or {}, names, first)
    used = ~np.array([one.check for one in exports])
    alone = _changed_alone(names, values, used)
    found, touched = {}, np.zeros(len(names), dtype=bool)
    models = [one.model for one in exports]
    both = {"stiffness": [one.stiffness for one in models], "mass": [one.mass for one in models]}
    for what, matrices in both.items():
        entries = Entries.of(matrices, models[0].dofs)
        changed = np.array([entries.changed_between(0, others) for others in alone])
        touched |= changed.any(axis=1)
        found[what] = recover(what, names, exports, values, used, entries, changed, np.array(ends).T)
    if not touched.all():
        name = names[int(np.argmin(touched))]
        raise ArgumentError(
            "exports", f"{name} must change the matrices (they are the same where it alone differs)"
        )
    first = exports[0].model
    model = SeparableModel(
        found["stiffness"].terms, found["mass"].terms, first.dofs, Geometry.of_mesh(first), motions=first.motions
    )
    model.names = names
    within = np.clip(values[0], *np.array(ends).T)
    said = [sentence for what, one in found.items() for sentence in one.sentences(what, names)]
    model.notes = (*first.notes, *said, *_of_digits(model, within, found["stiffness"]))
    return model


def _of_digits(model: SeparableModel, theta: FloatArray, found: Recovery) -> list[str]:
    """Return a list with a warning if the stiffness has too few digits for an accurate lowest frequency.

    The list is empty if there are enough digits, or if no elastic mode can be computed.

    With independent, uniform entry errors e_ij, λ changes by φᵀ e φ / φᵀ M φ. The relative change in f has the
    standard deviation ½ √(Σ_ij 2 (r K_ij φ_i φ_j)² / 3) / φᵀ K φ, where `Recovery.rounding` is used as the bound r
    on |e_ij / K_ij|.
    """
    K, M = model.K(theta), model.M(theta)
    try:
        eigenvalues, shapes = eigen(K, M, min(_RIGID + 1, K.shape[0]))
    except SingularMassError:  # too few masses: reported where the model is checked
        return []
    elastic = np.flatnonzero(~is_rigid(eigenvalues))
    if not len(elastic):
        return []
    phi = shapes[:, elastic[0]]
    entries = sp.coo_array(K)
    energy = entries.data * phi[entries.row] * phi[entries.col]
    sd = 0.5 * found.rounding * float(np.sqrt(2.0 * np.sum(energy**2) / 3.0) / abs(energy.sum()))
    if sd <= FREQUENCY_ROUNDING:
        return []
    f = hertz(float(frequency_hz(eigenvalues[elastic[:1]])[0]))[0]
    return [
        f"The {found.digits} digits of the exported stiffness give the lowest frequency, {f} Hz, to "
        f"{significant(sd, 1)}: larger steps of the parameters, files with more digits, or elements that are less "
        "thin make it better."
    ]


def _limits(
    bounds: Mapping[str, tuple[float, float]], names: tuple[str, ...], first: FloatArray
) -> list[tuple[float, float]]:
    """Return the bounds of each parameter. Raise ArgumentError if a name is unknown or bounds are not in order."""
    for name, (lower, upper) in bounds.items():
        if name not in names:
            raise ArgumentError("bounds", f"must be of {names_in_words(list(names))}", name)
        if not lower < upper:
            raise ArgumentError(f"bounds.{name}", "must be two numbers in ascending order", [lower, upper])
    return [bounds.get(name, (0.5 * x, 2.0 * x)) for name, x in zip(names, first.tolist(), strict=True)]


def _points(exports: Sequence[Export]) -> tuple[tuple[str, ...], FloatArray]:
    """Return the parameter names, and their values in each export, shape (n_exports, n_parameters).

    Raise ArgumentError if there are fewer than two exports, the first is a check or has no parameters, another
    names an unknown parameter, or a value is not finite or is zero in the first.
    """
    if len(exports) < 2:
        raise ArgumentError("exports", "must be at least 2", len(exports))
    names = tuple(exports[0].values)
    if not names:
        raise ArgumentError("exports.0.values", "must give the parameters", "none")
    if exports[0].check:
        raise ArgumentError(
            "exports.0.check", "must not be true: the first export is the one that others differ from"
        )
    for i, one in enumerate(exports):
        for name, value in one.values.items():
            if name not in names:
                raise ArgumentError(f"exports.{i}.values", f"must be of {names_in_words(list(names))}", name)
            if not np.isfinite(value) or (i == 0 and value == 0):
                raise ArgumentError(f"exports.{i}.values.{name}", "must be finite, and not zero at first", value)
    nominal = exports[0].values
    return names, np.array(
        [[one.values.get(name, nominal[name]) for name in names] for one in exports], dtype=float
    )


def _on_one_mesh(exports: Sequence[Export]) -> None:
    """Raise ArgumentError if an export and the first export differ in degrees of freedom or in `motions`.

    The motions differ if the weights of a motion differ (`fmu.formats.models.exported.ExportedModel`).
    """
    first = exports[0].model.dofs
    motions = exports[0].model.motions
    for i, one in enumerate(exports):
        if one.model.dofs != first:
            here, there = set(one.model.dofs), set(first)
            which = [f"node {node} {direction}" for node, direction in sorted(here ^ there)[:TOLD]]
            how = f"; only one of the two has {names_in_words(which)}" if which else ", in another order"
            raise ArgumentError(
                f"exports.{i}",
                f"must have the degrees of freedom of the first export, {len(there)} of one mesh",
                f"{len(here)}{how}",
            )
        for node, direction in {**motions, **one.model.motions}:
            weights, before = (own.get((node, direction), {}) for own in (one.model.motions, motions))
            names = sorted(weights.keys() | before.keys())
            size = max((abs(w) for w in (*weights.values(), *before.values())), default=0.0)
            if any(abs(weights.get(name, 0.0) - before.get(name, 0.0)) > _SAME_MOTION * size for name in names):
                raise ArgumentError(
                    f"exports.{i}",
                    f"must have the geometry of the first export (the motion of node {node} {direction} "
                    "depends differently on the nodes that it follows): with a length as a parameter, let the "
                    "program solve at every theta",
                )


def _changed_alone(names: Sequence[str], values: FloatArray, used: BoolArray) -> list[list[int]]:
    """Return, for each parameter, the indices of the exports in which only this parameter differs from the first.

    Only exports in the mask `used` count. Raise ArgumentError if a parameter has no such export.
    """
    differs = values != values[0]
    found = []
    for j, name in enumerate(names):
        alone = np.flatnonzero(used & differs[:, j] & (differs.sum(axis=1) == 1)).tolist()
        if not alone:
            raise ArgumentError(
                "exports", f"must have one, not kept for checking, in which only {name} differs from the first"
            )
        found.append(alone)
    return found
