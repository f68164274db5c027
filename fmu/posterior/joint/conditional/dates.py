"""Propose dates of sudden losses. All scores are integrated out, and all dates are considered at once.

An event causes losses d, and each test has a share r of them. The share is zero before the date and one after it;
it is in between if the date lies in the ramp before the test (`fmu.UndatedDamage`). Let all other main parameters
be given, and let the scores be integrated out. A test's log-evidence E_t then depends on r d alone. It is computed
without the loss, E_t(0), and to second order about typical losses (`ScoresGivenMain.log_evidence`). The
log-density of date and losses is a sum over the tests before the date and a quadratic form in d over the tests
after it. Both are cumulative sums over the test times, so all dates together cost two evaluations of E.

The date and the losses are proposed together: first the interval that contains the date, then the date (uniformly
within the interval), then the losses (from a normal distribution). The proposal depends on neither the current
date nor the current losses, because each would tie the other to its current value (collapsed Gibbs steps, Liu
1994, *J. Am. Stat. Assoc.* 89, 958–966).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmu.box import find_inside
from fmu.posterior.joint.conditional.scores import REGULAR, ScoresGivenMain
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.base import SuddenLoss, sum_by_test
from fmu.posterior.joint.varies.undated import RAMP
from fmu.posterior.parameters import Parameter, box
from fmu.posterior.priors.joint import JointPrior
from fmu.types import FloatArray, IntArray

_CELLS = 4
"""Number of intervals into which the ramp before a test is divided."""
_SD = 0.3
"""Standard deviation of the losses where the data have no information, as in the default prior."""


class _GivenDate(NamedTuple):
    """Probability of each interval for an event's date, and the distribution of the losses given the interval.

    Attributes
    ----------
    weight : ndarray, shape (n, n_intervals)
        Log-probability of each interval, up to a constant.
    mean : ndarray, shape (n, n_intervals, n_losses)
        Mean losses.
    factor : ndarray, shape (n, n_intervals, n_losses, n_losses)
        Cholesky factor of the losses' precision matrix.
    """

    weight: FloatArray
    mean: FloatArray
    factor: FloatArray


class DateOfEvent:
    """Proposal distribution for the date and the losses of a sudden event.

    Parameters
    ----------
    parameters : sequence of Parameter
        The parameters in theta.
    date : int
        Index of the date in theta.
    losses, numbers : ndarray of int, shape (n_losses,)
        Indices of the losses in theta, and indices of the damaged parameters among the structural parameters.
    times : ndarray, shape (n_tests,)
        Time of each test.
    about : ndarray, shape (n_losses,)
        Typical losses.
    """

    def __init__(
        self,
        parameters: Sequence[Parameter],
        date: int,
        losses: IntArray,
        numbers: IntArray,
        times: FloatArray,
        about: FloatArray,
    ) -> None:
        self.date, self.losses, self.numbers, self._about = date, losses, numbers, about
        distinct, self._time_of = np.unique(times, return_inverse=True)
        ramps = distinct[1:, None] - RAMP * np.diff(distinct)[:, None] * np.linspace(1.0, 0.0, _CELLS + 1)
        self._edges = np.append(distinct[0], ramps.ravel())
        self._middles, self._widths = 0.5 * (self._edges[1:] + self._edges[:-1]), np.diff(self._edges)
        # loss share in the first test after the date, for each interval
        self._share = np.append(1.0, 1.0 - (np.arange(_CELLS) + 0.5) / _CELLS)
        every = [parameters[k] for k in (date, *losses)]
        self._prior, self._columns = JointPrior(every), np.append(date, losses)
        self._low, self._high = box(every)

    def log_prior(self, theta: FloatArray) -> FloatArray:
        """Return the log-prior density of the date and the losses, shape (n,), at theta (n, ndim)."""
        return self._prior.log_pdf(theta[:, self._columns])

    def propose(
        self, rng: np.random.Generator, given: ScoresGivenMain, theta: FloatArray, scales: FloatArray = REGULAR
    ) -> tuple[FloatArray, FloatArray]:
        """Propose a new date and new losses for each chain.

        Parameters
        ----------
        rng : Generator
        given : ScoresGivenMain
        theta : ndarray, shape (n, ndim)
        scales : ndarray, shape (n, n_tests, p), optional
            Prior standard deviations of the scores (`Linear`).

        Returns
        -------
        theta : ndarray, shape (n, ndim)
            A copy with the proposed date and losses, or with the old ones if the new ones are outside the bounds.
        log_ratio : ndarray, shape (n,)
            Proposal log-density of the old values minus the proposal log-density of the new values; −∞ outside the
            bounds.
        """
        known, rows, found = self._given_date(given, theta, scales), np.arange(len(theta)), theta.copy()
        at = np.argmax(known.weight + rng.gumbel(size=known.weight.shape), axis=1)
        found[:, self.date] = self._edges[at] + self._widths[at] * rng.random(len(theta))
        turned, noise = (
            np.swapaxes(known.factor[rows, at], 1, 2),
            rng.standard_normal((len(theta), len(self.losses))),
        )
        found[:, self.losses] = known.mean[rows, at] + np.linalg.solve(turned, noise[..., None])[..., 0]
        inside = find_inside(found[:, self._columns], self._low, self._high)[0]
        ratio = np.where(inside, self._log_density(known, theta) - self._log_density(known, found), -np.inf)
        return np.where(inside[:, None], found, theta), ratio

    def likeliest(self, given: ScoresGivenMain, theta: FloatArray) -> FloatArray:
        """Return theta (1, ndim) with the most probable date and losses.

        The date is the middle of the interval with the largest probability per unit of time. The losses are
        clipped to their bounds.
        """
        known, found = self._given_date(given, theta, REGULAR), theta.copy()
        at = int(np.argmax(known.weight[0] - np.log(self._widths)))
        found[0, self.date] = self._middles[at]
        found[0, self.losses] = np.clip(known.mean[0, at], self._low[1:], self._high[1:])
        return found

    def _log_density(self, known: _GivenDate, theta: FloatArray) -> FloatArray:
        """Return the proposal log-density of the date and losses in theta, shape (n,), up to a constant."""
        rows, last = np.arange(len(theta)), len(self._widths) - 1
        at = np.clip(np.searchsorted(self._edges, theta[:, self.date], side="right") - 1, 0, last)
        factor = known.factor[rows, at]
        off = np.einsum("nji,nj->ni", factor, theta[:, self.losses] - known.mean[rows, at])
        scale = np.log(np.einsum("nii->ni", factor)).sum(axis=1) - np.log(self._widths[at])
        return np.asarray(known.weight[rows, at] + scale - 0.5 * np.einsum("ni,ni->n", off, off))

    def _given_date(self, given: ScoresGivenMain, theta: FloatArray, scales: FloatArray) -> _GivenDate:
        n_times = len(self._edges) // (_CELLS + 1) + 1
        before, after = theta.copy(), theta.copy()
        before[:, self.date], after[:, self.date] = self._high[0], self._low[0]
        after[:, self.losses] = about = self._about
        none = sum_by_test(given.log_evidence(given.linearise(before, scales)), self._time_of, n_times)
        linear, j = given.linearise(after, scales), self.numbers
        slopes = np.stack([self._by_loss(given, linear.at, k) for k in range(len(j))], axis=2)
        H = slopes[..., :, None] * given.information_on_values(linear)[:, :, j[:, None], j] * slopes[..., None, :]
        b = slopes * given.pull_of_values(linear)[:, :, j]
        c = given.log_evidence(linear) - np.einsum("nti,i->nt", b, about)
        c = c - 0.5 * np.einsum("ntij,i,j->nt", H, about, about)
        b = b + np.einsum("ntij,j->nti", H, about)
        c, b, H = (sum_by_test(one, self._time_of, n_times) for one in (c, b, H))
        c = c - none  # with the loss, relative to the evidence without it
        c, b, H = (self._after(one, power) for power, one in enumerate((c, b, H)))
        c = c + none.sum(axis=1)[:, None]
        H = H + np.eye(len(j)) / _SD**2
        factor = np.linalg.cholesky(H)
        mean = np.linalg.solve(H, b[..., None])[..., 0]
        weight = c + 0.5 * np.einsum("nci,nci->nc", mean, b) - np.log(np.einsum("ncii->nci", factor)).sum(axis=2)
        n, cells = weight.shape
        at = np.concatenate([np.broadcast_to(self._middles[:, None], (n, cells, 1)), mean], axis=2)
        at = np.clip(at, self._low, self._high)
        prior = self._prior.log_pdf(at.reshape(n * cells, -1)).reshape(n, cells)
        weight = weight + prior + 0.5 * np.einsum("nci,nci->nc", mean, mean) / _SD**2
        return _GivenDate(weight + np.log(self._widths), mean, factor)

    def _by_loss(self, given: ScoresGivenMain, theta: FloatArray, k: int) -> FloatArray:
        """Return the derivatives, (n, n_tests), of the parameter value in each test with respect to loss k."""
        slopes = given.layout.values_of[self.numbers[k]](theta)[1]
        return next(one.values for one in slopes if one.columns[0] == self.losses[k])

    def _after(self, terms: FloatArray, power: int) -> FloatArray:
        """Sum `terms` (n, n_times, …) over the tests after each date interval; return shape (n, n_intervals, …).

        The term of the first test after the interval is multiplied by that test's loss share to the `power`, or by
        the share itself if `power` is zero.
        """
        shape = (-1, *(1,) * (terms.ndim - 2))
        share = (self._share ** max(power, 1)).reshape(shape)
        total = np.flip(np.cumsum(np.flip(terms, 1), axis=1), 1)
        later = np.concatenate([total[:, 2:], np.zeros_like(total[:, :1])], axis=1)
        found = later[:, :, None] + share * terms[:, 1:, None]
        return found.reshape(len(terms), -1, *terms.shape[2:])


def undated_events(layout: Layout, parameters: Sequence[Parameter], theta: FloatArray) -> tuple[DateOfEvent, ...]:
    """Return the sudden events at unknown dates. Their typical losses are the losses at theta (ndim,)."""
    events: dict[int, list[tuple[int, SuddenLoss]]] = {}
    for j, value_of in enumerate(layout.values_of):
        if (one := value_of.sudden_loss) is not None:
            events.setdefault(one.date, []).append((j, one))
    found = []
    for date, every in events.items():
        losses, numbers = np.array([one.loss for _, one in every]), np.array([j for j, _ in every])
        found.append(DateOfEvent(parameters, date, losses, numbers, every[0][1].times, theta[losses]))
    return tuple(found)
