"""Joint prior of all parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fmu.posterior.joint.layout import Layout
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray


class JointPrior:
    """Product of all parameters' priors, truncated to the bounds and normalised between them.

    The common priors (normal, half-normal and log-normal) are evaluated together as one array.

    Parameters
    ----------
    parameters : sequence of Parameter
    layout : Layout, optional
        Layout of several tests with populations. If it is given, the prior is not a plain product, because the
        tests' scores in the populations may depend on each other and on the populations' parameters
        (`fmu.posterior.joint.layout.Layout.log_prior`).
    """

    def __init__(self, parameters: Sequence[Parameter], layout: Layout | None = None) -> None:
        self.parameters = tuple(parameters)
        self._layout = layout
        forms = [(j, form) for j, p in enumerate(parameters) if (form := p.prior.gaussian_form) is not None]
        forms.sort(key=lambda one: (one[1].of_logarithm, one[1].log_factor))
        self._gaussian = np.array([j for j, _ in forms], dtype=int)
        self._n_logs = sum(form.of_logarithm for _, form in forms)
        self._n_direct = len(forms) - self._n_logs
        # one row, like a single theta, so that NumPy need not broadcast
        self._mean = np.array([form.mean for _, form in forms])[None]
        self._precision = np.array([form.sd for _, form in forms]) ** -2.0
        self._others = [(j, p.prior) for j, p in enumerate(parameters) if p.prior.gaussian_form is None]
        log_mass = sum(p.prior.log_mass(p.lower, p.upper) for p in parameters)
        log_mass -= math.fsum(form.log_factor for _, form in forms)
        self._weight = -0.5 * self._precision
        self._constant = 0.5 * float(np.sum(np.log(self._precision / (2.0 * np.pi)))) - log_mass

    def log_pdf(self, theta: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at theta (n, ndim), which must be in the support of every prior."""
        # `take` gives C order, in which a row is summed in the same order whatever the batch size; einsum does not
        # warn of an overflow
        x = theta.take(self._gaussian, axis=1)
        constant: float | FloatArray = self._constant
        if self._n_logs:
            x[:, self._n_direct :] = np.log(x[:, self._n_direct :])
            constant = constant - np.einsum("nj->n", x[:, self._n_direct :])
        z = x - self._mean
        value = constant + np.einsum("nj,nj,j->n", z, z, self._weight)
        for j, prior in self._others:
            value = value + prior.log_pdf(theta[:, j])
        return value if self._layout is None else self._layout.log_prior(theta, value)

    def log_pdf_gradient(self, theta: FloatArray) -> FloatArray:
        """Return the gradient of the log-density, shape (n, ndim), at theta (n, ndim)."""
        gradient = np.empty_like(theta)
        x = theta.take(self._gaussian, axis=1)
        with np.errstate(over="ignore"):
            if self._n_logs:
                x_of_logs = x[:, self._n_direct :].copy()
                x[:, self._n_direct :] = np.log(x_of_logs)
            slope = -self._precision * (x - self._mean)
            if self._n_logs:
                slope[:, self._n_direct :] = (slope[:, self._n_direct :] - 1.0) / x_of_logs
        gradient[:, self._gaussian] = slope
        for j, prior in self._others:
            gradient[:, j] = prior.log_pdf_gradient(theta[:, j])
        return gradient if self._layout is None else self._layout.log_prior_gradient(theta, gradient)

    def quadratic(self, theta: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the slope (n, ndim) and the curvature −∇² (n, ndim, ndim) of the log-density at theta (n, ndim).

        Both are derivatives with respect to theta/`scale`. Each parameter's curvature is a central difference of
        slopes with a step of 1e-4 of its scale, taken a little inside the prior's support. Curvatures that are
        negative or NaN, as beside an interval without density, are set to zero. The curvature with respect to a
        test's score ignores the bounds.
        """
        slope, curvature = np.empty_like(theta), np.zeros((*theta.shape, theta.shape[1]))
        for k, parameter in enumerate(self.parameters):
            h = 1e-4 * scale[k]
            low, high = parameter.prior.support
            near = np.clip(theta[:, k], low + 2.0 * h, high - 2.0 * h)
            ahead, behind = (parameter.prior.log_pdf_gradient(near + step) for step in (h, -h))
            curvature[:, k, k] = np.fmax(0.0, (behind - ahead) / (2.0 * h)) * scale[k] ** 2
            slope[:, k] = parameter.prior.log_pdf_gradient(theta[:, k]) * scale[k]
        if self._layout is None:
            return slope, curvature
        curvature = self._layout.log_prior_curvature(theta, curvature, scale)
        return self.log_pdf_gradient(theta) * scale, curvature

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors, shape (n, ndim)."""
        theta = np.stack([p.prior.draw(rng, n, p.lower, p.upper) for p in self.parameters], axis=1)
        return theta if self._layout is None else self._layout.draw_from_prior(theta, rng)
