"""Frequency response functions of oscillators in closed form, and FRFs of measured kinds with noise."""

import numpy as np

import fmu

KINDS = ("receptance", "mobility", "accelerance")


def chain(free=False):
    """Return the eigenvalues (3,) and the mass-normalised shapes (3, 3) of a chain of three masses of 2 kg."""
    K = np.array([[1.0 if free else 2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]]) * 4e4
    values, shapes = np.linalg.eigh(K / 2.0)
    return np.maximum(values, 0.0), shapes / np.sqrt(2.0)


def receptances(f, eigenvalues, shapes, zeta, pairs):
    """Return Σ_r φ_jr φ_kr/(λ_r − ω² + 2iζ_r ω_r ω) of pairs (j, k) of response and drive, (n_pairs, n_lines)."""
    omega = 2.0 * np.pi * np.asarray(f)[:, None]
    denominator = eigenvalues - omega**2 + 2j * zeta * np.sqrt(eigenvalues) * omega
    return np.array([np.sum(shapes[j] * shapes[k] / denominator, axis=1) for j, k in pairs])


def measured(pairs, k=2, *, free=False, zeta=(0.01, 0.02, 0.01), f=None, noise=0.0, seed=0, said=None, **settings):
    """Return FRFs of the chain as data: the kind of (iω)^k with relative noise, and its sd if there is noise."""
    f = np.linspace(0.1, 60.0, 600) if f is None else f
    values = receptances(f, *chain(free), np.array(zeta), pairs) * (2j * np.pi * f) ** k
    sd = noise * np.abs(values) / np.sqrt(2.0)
    z = np.random.default_rng(seed).standard_normal((2, *values.shape))
    settings = ({"sd": sd} if noise else {}) | settings
    drives, responses = (tuple((pair[end], "x") for pair in pairs) for end in (1, 0))
    return fmu.FRFData(f, values + sd * (z[0] + 1j * z[1]), drives, responses, said or KINDS[k], **settings)
