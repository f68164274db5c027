"""The prior of a hierarchical problem: independent parameters, and scores that refer to a population."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmu.posterior.joint.layout import Layout
from fmu.posterior.parameters import JointPrior, Parameter
from fmu.types import FloatArray


class ScoredPrior(JointPrior):
    """The priors of the parameters, where the priors of scores depend on a population.

    Parameters
    ----------
    parameters : sequence of Parameter
        The scores have standard normal priors, which hold where nothing is centred.
    layout : Layout
    """

    def __init__(self, parameters: Sequence[Parameter], layout: Layout) -> None:
        super().__init__(parameters)
        self._drawn = layout.drawn
        self._centred = [one for one in self._drawn if np.any(one.centring > 0.0)]
        self._layout = layout

    def log_pdf(self, theta: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at theta (n, ndim) where every prior has a density."""
        value = super().log_pdf(theta)
        for one in self._centred:
            value = value + np.einsum("nt->n", one.log_prior(theta)[0])
        if self._layout.correlation is not None:
            z = np.stack([one.population_scores(theta)[0] for one in self._drawn], axis=2)
            value = value + self._layout.correlation.log_density(theta, z)[0]
        return value

    def log_pdf_gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient, shape (n, ndim)."""
        gradient = super().log_pdf_gradient(theta)
        for one in self._centred:
            by_score, by_centre, by_width = one.log_prior(theta)[1]
            gradient[:, by_score.columns[one.scored]] += by_score.values[:, one.scored]
            for slope in (by_centre, by_width):
                gradient[:, slope.columns[0]] += np.einsum("nt->n", slope.values)
        if self._layout.correlation is not None:
            found = [one.population_scores(theta) for one in self._drawn]
            z = np.stack([z for z, _ in found], axis=2)
            _, by_z, by_correlation = self._layout.correlation.log_density(theta, z)
            gradient[:, self._layout.correlation.columns] += by_correlation
            for j, (one, (_, slopes)) in enumerate(zip(self._drawn, found, strict=True)):
                of_score, *of_both = (by_z[:, :, j] * np.where(one.scored, s, 0.0) for s in slopes)
                gradient[:, one.columns[one.scored]] += of_score[:, one.scored]
                for column, of_all in zip((one.centre, one.width), of_both, strict=True):
                    gradient[:, column] += np.einsum("nt->n", of_all)
        return gradient

    def quadratic(self, theta: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope and curvature, parameters in units of `scale`; by scores as without bounds."""
        curvature = super().quadratic(theta, scale)[1]
        for one in self._centred:
            columns = one.columns[one.scored]
            curvature[:, columns, columns] = one.curvature(theta)[:, one.scored] * scale[columns] ** 2
        if self._layout.correlation is not None:
            precision = self._layout.correlation.precision(theta)
            slopes = [np.sqrt(one.curvature(theta)) for one in self._drawn]
            for i, of_rows in enumerate(self._drawn):
                for j, of_columns in enumerate(self._drawn):
                    here = of_rows.scored & of_columns.scored
                    rows, columns = of_rows.columns[here], of_columns.columns[here]
                    of_both = precision[:, here, i, j] * slopes[i][:, here] * slopes[j][:, here]
                    curvature[:, rows, columns] += of_both * scale[rows] * scale[columns]
        return self.log_pdf_gradient(theta) * scale, curvature

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors, shape (n, ndim)."""
        theta = super().draw(rng, n)
        if self._layout.correlation is not None:
            z = self._layout.draw_scores(theta, rng, self._layout.n_tests)
            for j, one in enumerate(self._drawn):
                theta[:, one.columns[one.scored]] = z[:, one.scored, j]
        for one in self._centred:
            theta = one.drawn(theta)
        return theta
