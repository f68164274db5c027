"""Shear buildings: rigid floors on columns without mass, with one degree of freedom a floor."""

import numpy as np
import scipy.linalg

import fmu


def storey(j, n):
    """Return the stiffness matrix (n, n) of storey `j` of `n`, from 0, whose columns have a stiffness of one."""
    drift = np.zeros(n)
    drift[j] = 1.0
    if j:
        drift[j - 1] = -1.0
    return np.outer(drift, drift)


def shear_building(names, stiffness=1.0, mass=1.0, mass_name=None, dofs=None):
    """Return the structure whose parameters multiply the stiffnesses of its storeys.

    Parameters
    ----------
    names : sequence of str
        The parameter of each storey from below; storeys may share one.
    stiffness : float
        Of every storey where its parameter is one, N/m.
    mass : float or ndarray
        Of the floors, kg: one for all, one of each, or a matrix (n, n).
    mass_name : str, optional
        The parameter that multiplies the masses.
    dofs : sequence of (node, direction), optional
    """
    n = len(names)
    parameters = list(dict.fromkeys(names))
    K = {name: stiffness * sum(storey(j, n) for j in range(n) if names[j] == name) for name in parameters}
    M = np.diag(np.broadcast_to(mass, n)) if np.ndim(mass) < 2 else mass
    return fmu.SeparableModel.from_terms(
        parameters + [mass_name] * (mass_name is not None),
        [(K[name], name) for name in parameters],
        [M if mass_name is None else (M, mass_name)],
        dofs=dofs,
    )


def frequencies_hz(model, theta):
    """Return frequencies (n,), Hz, and shapes of unit length of a structure at theta (ndim,), by LAPACK alone."""
    values, shapes = scipy.linalg.eigh(model.K(theta).toarray(), model.M(theta).toarray())
    return np.sqrt(values) / (2 * np.pi), shapes / np.linalg.norm(shapes, axis=0)


def two_frequencies_hz(stiffness, masses=(16e3, 12e3)):
    """Return both frequencies (…, 2), Hz, of two storeys of stiffnesses (…, 2), N/m, and masses of two floors, kg.

    They are the roots of the characteristic equation; the lower one comes from the product, free of cancellation.
    """
    (k1, k2), (m1, m2) = np.moveaxis(np.asarray(stiffness), -1, 0), masses
    total, product = (k1 + k2) / m1 + k2 / m2, k1 * k2 / (m1 * m2)
    upper = 0.5 * (total + np.sqrt(total**2 - 4 * product))
    return np.sqrt(np.stack([product / upper, upper], axis=-1)) / (2 * np.pi)
