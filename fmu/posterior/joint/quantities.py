"""Use masses, displacements and frequency response functions, each measured in one of several tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fmu.arguments import as_list, shown
from fmu.fem.modes.separable import separable_in
from fmu.formats.shown import names_shown
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.quantities import QuantityErrors, QuantityTerm
from fmu.posterior.frf.damping import inferred_in
from fmu.posterior.frf.errors import FRFErrors
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.model_in_tests import ModelInTests
from fmu.posterior.parameters import Parameter, parameter_in
from fmu.posterior.priors.base import Uniform
from fmu.types import FloatArray, IntArray


class Errors(NamedTuple):
    """Error models for several tests, sorted into models for modes and models for other quantities.

    Attributes
    ----------
    of_modes : str, ErrorModel or sequence of ErrorModel
        Error models for the modes of all tests; ``"frequency"`` if none is given.
    of_quantities : mapping of int to QuantityErrors
        Error models for masses, displacements and FRFs, keyed by their index in the argument `error`.
    """

    of_modes: Any
    of_quantities: Mapping[int, QuantityErrors]

    @classmethod
    def of(cls, error: str | ErrorModel | Sequence[ErrorModel]) -> Errors:
        """Sort the user's error models into models for modes and models for other quantities."""
        given: Any = as_list(error)
        quantities = {i: one for i, one in enumerate(given) if isinstance(one, QuantityErrors)}
        if not quantities:
            return cls(error, {})
        return cls([one for i, one in enumerate(given) if i not in quantities] or "frequency", quantities)

    @property
    def of_frfs(self) -> dict[int, FRFErrors]:
        """Error models for frequency response functions, keyed by their index in the argument `error`."""
        return {i: one for i, one in self.of_quantities.items() if isinstance(one, FRFErrors)}

    def damping_parameters(self) -> list[Parameter]:
        """Return the inferred damping parameters of all tests. Each is listed once."""
        found: list[Parameter] = []
        for one in self.of_frfs.values():
            found += [p for p in inferred_in(one.damping) if p not in found]
        return found

    def find_mistakes(self, model: Any, tests: Sequence[str]) -> list[str]:
        """Return error messages about contradictions between error models, model and tests."""
        rule = f"must be the test in which it was measured, one of {names_shown(tests)}"
        found = [
            f"error.{i}.test: {rule} (got {'none' if one.test is None else shown(one.test)})"
            for i, one in self.of_quantities.items()
            if one.test not in tests
        ]
        of_tests = [one.test for one in self.of_frfs.values()]
        rule = "must not be that of another FRFErrors; give all frequency response functions of a test together"
        found += [
            f"error.{i}.test: {rule} (got {shown(one.test)})"
            for k, (i, one) in enumerate(self.of_frfs.items())
            if one.test in of_tests[:k]
        ]
        if self.of_frfs and self.of_modes == "frequency" and not found:
            without = [test for test in tests if test not in of_tests]
            rule = "must be given for every test, or errors of modes too"
            found += [f"error: frequency response functions {rule} (got none of {names_shown(without)})"] * bool(
                without
            )
        if self.of_quantities and separable_in(model) is None:
            first = next(iter(self.of_quantities))
            what = "a frequency response function" if self.of_frfs else "a mass or a displacement"
            found.append(
                f"error.{first}: {what} needs a model with matrices, a SeparableModel (got {type(model).__name__})"
            )
        return found

    def find_vanishing(self, layout: Layout, of_model: int) -> dict[str, str]:
        """Return a rule, keyed by name, for each inferred sd that may make the posterior density unbounded.

        Let n errors have this sd and no known sd. If all of them can be zero, the likelihood grows as sd^(−n) as
        sd → 0. This is possible if, in each test and in all tests together, there are no more errors than
        parameters that act on them. The posterior is still bounded if the prior decreases faster.

        Parameters
        ----------
        layout : Layout
        of_model : int
            Number of parameters of the model. The other structural parameters are damping parameters, which act on
            FRFs only.
        """
        counts: dict[str, IntArray] = {}
        sds: dict[str, Parameter] = {}
        damped: set[str] = set()
        models: list[Any] = [one for one in as_list(self.of_modes) if not isinstance(one, str)]
        for model in [*models, *self.of_quantities.values()]:
            own = {p.name: p for value in vars(model).values() if (p := parameter_in(value)) is not None}
            here = [getattr(model, "test", None) in (None, test.name) for test in layout.tests]
            is_known = [
                model.data_give_sd(test.data) if model.sd is None else parameter_in(model.sd) is None
                for test in layout.tests
            ]
            n_errors = np.array([model.n_errors(test.data) for test in layout.tests])
            counts |= {name: counts.get(name, 0) + n_errors * here * np.logical_not(is_known) for name in own}
            sds |= own
            damped |= set(own) if isinstance(model, FRFErrors) else set()
        found, scales = {}, layout.scales
        for name, sd in sds.items():
            last = len(layout.structural) if name in damped else of_model
            acting = [p.name for p in layout.structural[:last] if p.updated]
            in_tests = [len(set(acting) - set(test.known)) for test in layout.tests]
            each = [k for k, role in enumerate(layout.roles) if role.of is None or role.of < last]
            n_parameters, n = len(set(each) - set(scales)), int(counts[name].sum())
            can_be_zero = 0 < n <= n_parameters and bool(np.all(counts[name] <= in_tests))
            nearly_none = sd.start * np.array([1e-6, 1e-9])
            density = sd.prior.log_pdf(nearly_none) - n * np.log(nearly_none)
            if can_be_zero and sd.lower == 0.0 and density[1] > density[0]:
                found[name] = (
                    f"must be positive (or use a log-normal prior): {n_parameters} parameters can fit these {n} "
                    f"errors exactly, and the probability density is unbounded as the deviation tends to zero"
                )
        return found


class StructureInTest(NamedTuple):
    """The structure in one of several tests.

    Attributes
    ----------
    structure : SeparableModel
    parameters : list of Parameter
        The structure's p parameters. Their bounds are finite and include nearly all values in the test
        (`Layout.box`).
    test : int
        Index of the test.
    numbers : ndarray of int, shape (p,)
        Indices of these p parameters among the structural parameters.
    """

    structure: Any
    parameters: list[Parameter]
    test: int
    numbers: IntArray

    @classmethod
    def of(cls, test: str | None, joint: ModelInTests, layout: Layout) -> StructureInTest:
        """Return the structure in the test named `test`."""
        lower, upper = layout.box()
        t = joint.tests.index(str(test))
        model, numbers = joint.in_test(t)
        parameters = [_close_box(layout.structural[j], lower[t, j], upper[t, j]) for j in numbers]
        return cls(model.structure, parameters, t, numbers)


def bind_quantities(
    given: Mapping[int, QuantityErrors], joint: ModelInTests, layout: Layout
) -> tuple[QuantityTerm, ...]:
    """Return one likelihood term per error model in `given`, as a function of the parameters in all tests.

    A term's labels begin with the name of its test. `given` is keyed by the error model's index in `error`.

    Raises
    ------
    ValueError
        If a quantity cannot be computed for the structure in its test.
    """
    found = []
    for i, one in given.items():
        here = StructureInTest.of(one.test, joint, layout)
        try:
            term = one.bind_structure(here.structure, here.parameters)
        except ValueError as error:
            raise ValueError(f"error.{i}.{error}") from error
        labels = tuple(f"{one.test}: {label}" for label in term.labels)
        columns = here.test * joint.n_structural + here.numbers
        computed = InOneTest(term.computed, columns, here.numbers, joint.n_structural)
        found.append(term._replace(labels=labels, computed=computed, test=here.test))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class InOneTest:
    """Quantities computed for the structure in one test, as a function of the parameters in all tests.

    Attributes
    ----------
    computed : callable
        Computes the quantities from p structural parameters in the test; see
        `fmu.posterior.errors.quantities.QuantityTerm`.
    columns : ndarray of int, shape (p,)
        Indices of the p parameters among the parameters in all tests.
    parameters : ndarray of int, shape (p,)
        Indices of the p parameters among the structural parameters.
    n_structural : int
        Number of structural parameters.
    """

    computed: Callable[[FloatArray, bool], tuple[FloatArray, FloatArray | None]]
    columns: IntArray
    parameters: IntArray
    n_structural: int

    def __call__(self, theta: FloatArray, gradient: bool = False) -> tuple[FloatArray, FloatArray | None]:
        """Return the quantities, (n, q), and their derivatives with respect to the test's structural parameters.

        The derivatives have the shape (n, q, n_structural); they are None unless `gradient` is True.
        """
        values, by_own = self.computed(theta[:, self.columns], gradient)
        if by_own is None:
            return values, None
        slopes = np.zeros((*values.shape, self.n_structural))
        slopes[:, :, self.parameters] = by_own
        return values, slopes


def over(p: Parameter, lower: float, upper: float) -> Parameter:
    """Return `p` if its bounds include the interval, otherwise a copy with a uniform prior on the interval."""
    if p.lower <= lower and upper <= p.upper:
        return p
    return replace(p, lower=lower, upper=upper, prior=Uniform(), start=float(np.clip(p.start, lower, upper)))


def _close_box(p: Parameter, lower: float, upper: float) -> Parameter:
    """Return `over(p, lower, upper)`, with any infinite bound replaced by the interval's limit."""
    found = over(p, lower, upper)
    low = found.lower if np.isfinite(found.lower) else float(lower)
    high = found.upper if np.isfinite(found.upper) else float(upper)
    return replace(found, lower=low, upper=high)
