"""The updating problem, which defines the log-probability that every sampler evaluates."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace
from importlib import import_module
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Interval
from numpy.typing import ArrayLike

from fmu.arguments import OwnRule, check_arguments
from fmu.engines.base import Engine
from fmu.fem.pairing.modal_model import Model
from fmu.fem.pairing.paired_structure import largest_block
from fmu.fem.pairing.rules import SOFTNESS
from fmu.posterior.build import check_held, check_names, likelihood_of, paired_model
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.density import Posterior
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.failures import FailureRecord
from fmu.posterior.joint.layout import Layout
from fmu.posterior.parameters import Parameter
from fmu.posterior.reduction.tolerance import Tolerance
from fmu.posterior.reduction.train_reduced import reduced_model
from fmu.posterior.rounding import require_digits
from fmu.progress.phases import phase
from fmu.types import FloatArray, Positive


class UpdatingProblem(Posterior):
    """The posterior of eq. (8) of Boulkaibet et al.: a model, a measurement and the parameters' priors.

    This class solves the full model; `reduced` makes the same problem with a reduced model, which is much faster.
    All equation numbers refer to the paper by Boulkaibet et al. (`fmu.paper.published`).

    Parameters
    ----------
    model : SeparableModel, BlackBoxModel or ModalModel
        The structure, a user's function, or any map from theta to the frequencies of the measured modes. If there
        are several tests (`fmu.JointProblem`), the model maps the parameters in all tests to the modes measured in
        all tests.
    data : ModalData
    parameters : sequence of Parameter
        Parameters of the model. theta consists of the updated parameters, in this order, followed by the
        inferred parameters of `error` and `discrepancy`, such as standard deviations.
    pairing : {"shape", "index", "soft"}
        How the modes of a SeparableModel are paired with the measured modes (`fmu.fem.pairing.rules`).
        ``"shape"``: by MAC with the measured shapes or, if there are none, with the model's modes before updating.
        ``"index"``: by number in the sorted spectrum. ``"soft"``: each measured mode is compared with all
        candidate modes, with weights exp(MAC/τ), so that the log-probability does not jump where modes veer; see
        `fmu.posterior.errors.mixture` for the limits of this pairing. The modes of a user's function are paired
        by MAC for ``"shape"`` if shapes were measured and the function returns shapes, otherwise by number.
    softness : float
        The temperature τ of the weights, for ``"soft"`` only.
    beta : float or array_like, shape (n_modes,), optional
        Trust in the data, β = 1/(2σ²) (eq. 4): 1/Hz² for frequencies, dimensionless for the modal residual. By
        default, the standard deviations or the covariance in `data` determine the frequency errors. If `data` have
        neither, and for the modal residual, β is 1 by default, as in the paper. `beta` must not be given together
        with error models or, for frequencies, if `data` have standard deviations or a covariance.
    error : {"frequency", "modal-residual"}, ErrorModel, or sequence of ErrorModel
        ``"frequency"``: ε = f − f^m in Hz, where f is the computed and f^m the measured frequency.
        ``"modal-residual"``: the residual of eq. (2) at the sensors, a pseudo-likelihood that needs measured
        shapes and a SeparableModel (`fmu.posterior.errors.residual`).
        Error models: their log-densities are summed. They are `fmu.FrequencyErrors`, `fmu.StudentErrors`,
        `fmu.ShapeErrors` and `fmu.MACErrors` for modes, and `fmu.MassErrors`, `fmu.StaticErrors` and
        `fmu.FRFErrors` for other data. If there are only error models of masses or displacements, the frequencies
        keep their default errors. If there are only error models of frequency response functions, the modes do not
        count as data. They are still paired, and the search for maxima starts with the likelihood of the modes.
    discrepancy : Discrepancy or sequence of Discrepancy, optional
        Model discrepancy, in addition to measurement errors.
    name : str
    layout : Layout, optional
        The map from theta to the structural parameters in each of several tests. By default there is one test.

    Attributes
    ----------
    ndim : int
    n_structural : int
        Number of parameters in theta before the inferred parameters of the errors.
    names, units : tuple of str
    lower, upper, start : ndarray, shape (ndim,), SI units
    offset, scale : ndarray, shape (ndim,)
        (theta − offset)/scale is of order one; with two finite bounds it usually lies between 0 and 1.
    prior : JointPrior
    layout : Layout
    tests : tuple of Test
        The tests of the structure; one unless the structure was tested several times.
    roles : tuple of Role
        The role of each parameter of theta.
    tolerance : Tolerance or None
        Errors allowed in the reduced model; None if there is no reduced model; see `reduced`.
    failures : list of Failure
        ``(theta, reason)`` for the first ten thousand theta inside the bounds at which the solve failed or the
        log-likelihood was not finite.
    n_failures : int
        Number of all failed evaluations.
    is_hierarchical : bool
        Whether the distribution of some parameters is itself inferred (`fmu.Population`). The maximum of such a
        posterior lies far from most of its probability.

    Raises
    ------
    ValueError
        If an argument is unknown or out of range, `beta` is given where it is not allowed, the model, the pairing,
        a discrepancy or an error model does not fit the parameters or the data, two parameters share a name, no
        parameter is updated, no mode is used although modes are the data, a structure has no finite
        log-probability at the start, or the rounding errors of the matrices exceed the measurement errors
        (`fmu.posterior.rounding`).

    Warns
    -----
    RoundingWarning
        If the rounding errors are not negligible compared with the measurement errors.

    Notes
    -----
    theta is in SI units throughout. ``log_prob`` maps ``(ndim,)`` to a float and ``(n, ndim)`` to ``(n,)``, and
    raises ValueError for any other shape. It is ``-inf`` outside the bounds and where a solve fails.
    """

    @check_arguments
    def __init__(
        self,
        model: Annotated[Model, OwnRule()],
        data: ModalData,
        parameters: Sequence[Parameter],
        *,
        pairing: str = "shape",
        softness: Positive = SOFTNESS,
        beta: Annotated[ArrayLike, Gt(0.0)] | None = None,
        error: str | ErrorModel | Sequence[ErrorModel] = "frequency",
        discrepancy: Discrepancy | Sequence[Discrepancy] = (),
        name: str = "problem",
        layout: Layout | None = None,
    ) -> None:
        check_names(parameters)
        self.data, self.name = data, name
        self.layout = Layout.of_one(parameters, data) if layout is None else layout
        self.n_structural = len(self.layout.parameters)
        self.tolerance: Tolerance | None = None
        with phase("modes at the start"):
            self.model = paired_model(model, data, parameters, pairing, softness)
        check_held(self.layout, self.model)
        self.likelihood = likelihood_of(error, beta, model, self.model, data, parameters, discrepancy, self.layout)
        if self.likelihood.used is not None and not len(self.likelihood.used):
            self.data = replace(data, use=(False,) * data.n_modes)  # other data determine the parameters
        self._failed = FailureRecord()
        self._take_parameters()
        check_names(self.parameters)
        require_digits(self)

    @classmethod
    @check_arguments
    def reduced(
        cls,
        *args: Any,
        reduction: Annotated[bool | float, OwnRule()] = True,
        engine: Engine | None = None,
        **options: Any,
    ) -> UpdatingProblem:
        """Return a problem in which a certified reduced model replaces a SeparableModel inside the bounds.

        The reduced model is trained here, or read from the cache (`fmu.posterior.reduction.train_reduced`). Any
        other model is used unchanged, and so is a SeparableModel for which a reduced model would not save time.

        Parameters
        ----------
        *args, **options
            The arguments of `UpdatingProblem`.
        reduction : bool or float
            Largest relative frequency error of the reduced model, above 0 and at most 0.01. True means 1e-6. If a
            block of the matrices has 20 000 degrees of freedom or more, True means 1e-3, and less where the
            log-probability requires it. The largest log-probability error follows from this value
            (`fmu.posterior.reduction.tolerance.Tolerance.of`). False selects the full model.
        engine : Engine, optional
            The engine whose workers train the reduced model (see `fmu.engine`). The result is the same to the last
            bit as without an engine. The problem keeps no reference to the engine.

        Raises
        ------
        ValueError
            In the cases listed for `UpdatingProblem`, if `reduction` is out of range, or if, somewhere inside the
            bounds, a displacement has neither stiffness nor mass, or has negative mass.

        Warns
        -----
        ReductionWarning
            If the full model must be used because it has no modes at draws from the prior, if the reduced model
            misses its tolerance or meets it only in a part of the box, or if K is negative or the reduced model's
            errors are not bounded well in a part of the box.
        RoundingWarning
            As in `UpdatingProblem`.
        """
        Tolerance.of(reduction)  # raise its errors before the expensive work
        problem = cls(*args, **options)
        tolerance = Tolerance.of(reduction, max(map(largest_block, problem.model.parts), default=0))
        if tolerance is None:
            return problem
        problem.tolerance = tolerance
        if problem.layout.held:  # a scatter needs their derivatives too: update them in training
            given = dict(zip(("model", "data", "parameters"), args, strict=False)) | options
            given["parameters"] = [replace(p, updated=True) for p in given["parameters"]]
            every = cls.reduced(**given | {"discrepancy": ()}, reduction=reduction, engine=engine)
            model, tolerance = every.model, every.tolerance
        else:
            model, tolerance = reduced_model(problem, tolerance, engine)
        reduced = problem.with_model(model)
        reduced.tolerance = tolerance
        if model.sizes:
            require_digits(reduced)  # the reduced model adds its own rounding
        return reduced

    @check_arguments
    def using(self, labels: Collection[str]) -> UpdatingProblem:
        """Return the same problem updated with the named modes only. Both problems share any reduced model.

        Parameters
        ----------
        labels : collection of str
            Names of the modes whose measurement is used; the other modes are paired and predicted only.

        Raises
        ------
        ValueError
            If a name is unknown, or no mode is named.
        """
        unknown = [name for name in labels if name not in self.data.labels]
        if unknown:
            raise ValueError(f"labels: must be of {', '.join(self.data.labels)} (got {unknown[0]!r})")
        if not labels:
            raise ValueError(f"labels: must name at least one of {', '.join(self.data.labels)} (got none)")
        other = copy(self)
        other.data = replace(self.data, use=tuple(label in labels for label in self.data.labels))
        other.likelihood = self.likelihood.using(other.data.used)
        other._failed = FailureRecord()
        return other

    @check_arguments
    def coarser(self, share: Annotated[float, Interval(gt=0, le=1)]) -> UpdatingProblem:
        """Return a copy whose reduced model has only a share of its basis vectors. Other models are unchanged.

        A solve then takes less time and is less accurate, which is enough for approximations such as proposals.
        Raise ValueError unless `share` is above 0 and at most 1.
        """
        return self.with_model(self.model.coarser(share))

    def __repr__(self) -> str:
        return f"UpdatingProblem({self.name!r}, {self.ndim} parameters, {self.data.n_modes} modes, {self.model!r})"

    def _repr_html_(self) -> str:
        from fmu.posterior.card import problem_card

        return problem_card(self)

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors from the truncated prior, shape (n, ndim)."""
        return np.clip(self.prior.draw(rng, n), self._lowest, self._highest)

    def walkers(self, n: int, seed: int = 1) -> FloatArray:
        """Return starting points for the walkers of an ensemble sampler such as emcee, shape (n, ndim), SI units.

        The points are distributed over the posterior's maxima in proportion to each maximum's probability. Around
        each maximum they scatter twice as widely as the posterior, within the bounds and where the log-probability
        is finite (`fmu.analysis.maxima.starts.starts_at_maxima`). For a hierarchical posterior they surround its
        typical point instead. If the density is infinite at a bound, the points are drawn from the prior. The
        maxima are found once and cached (`fmu.find_map`). Use another seed to get different points, for another
        ensemble.

        Parameters
        ----------
        n : int
            At least twice the number of parameters.
        seed : int

        Raises
        ------
        ValueError
            If `n` or `seed` is out of range, or no point with a finite log-probability is found.
        """
        # the search for maxima belongs to a higher layer, so it is imported only when this method is called
        found: FloatArray = import_module("fmu.analysis.maxima.starts").walkers(self, n, seed)
        return found

    def simulate_data(
        self,
        rng: np.random.Generator,
        frequencies: FloatArray,
        theta: FloatArray | None = None,
        same_structure: bool = False,
    ) -> FloatArray:
        """Return computed frequencies with simulated measurement errors added, in Hz, shape (n, n_modes).

        A model discrepancy is simulated too.

        Parameters
        ----------
        rng : Generator
        frequencies : ndarray, shape (n, n_modes), Hz
            Computed frequencies.
        theta : ndarray, shape (n, ndim), optional
            The parameter vectors at which `frequencies` were computed. They must be given if error parameters are
            inferred, or if there is a model discrepancy.
        same_structure : bool
            True to draw the model discrepancy of the measured structure, given the data. False to draw the
            discrepancy of a similar structure.

        Raises
        ------
        ValueError
            If there is no error model of frequencies, as with errors of shapes alone or the modal residual, or if
            `theta` must be given and is None.
        """
        frequencies = self._with_discrepancy(rng, frequencies, theta, same_structure)
        return self.likelihood.simulate(rng, frequencies, self._noise(theta))

    def simulate_test(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None = None
    ) -> FloatArray:
        """Return simulated frequencies of one further test, in Hz, shape (n, n_modes), for computed `frequencies`.

        By contrast, `simulate_data` simulates the data, which are the mean of several tests and scatter less than
        one test (`fmu.posterior.data.repeated.RepeatedTests.simulate`). The parameters are the same as in
        `simulate_data`; the further test is of the same structure.

        Raises
        ------
        ValueError
            If the data are not the mean of several tests, or `theta` must be given and is None.
        """
        if self.data.tests is None:
            raise ValueError("data: must be the mean of repeated tests to simulate one more (got no tests)")
        frequencies = self._with_discrepancy(rng, frequencies, theta, True)
        frequencies = self.likelihood.simulate_discrepancy(rng, frequencies, self._noise(theta))
        return np.asarray(frequencies + self.data.tests.simulate(rng, len(frequencies)))

    def _with_discrepancy(
        self,
        rng: np.random.Generator,
        frequencies: FloatArray,
        theta: FloatArray | None,
        same_structure: bool,
    ) -> FloatArray:
        of_model = None if theta is None else self.layout.of_model(theta)
        return self.likelihood.with_discrepancy(rng, frequencies, of_model, same_structure)
