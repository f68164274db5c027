"""Sort several tests into configurations: groups with the same matrices and sensors, solved in one batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from fmu.arguments import ArgumentError, first_repeated
from fmu.fem.modes.changes import changed_model
from fmu.fem.modes.separable import separable_in
from fmu.fem.pairing.modal_model import Model, PartialModel
from fmu.posterior.build import modal_model_in
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.picked_modes import PICKED_SD
from fmu.posterior.data.repeated import mean_shapes
from fmu.posterior.data.stacked import StackedData, stacked_freedom_of_shapes, stacked_tests
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.posterior.joint.model_in_tests import Configuration
from fmu.posterior.joint.quantities import over
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray


def stack_tests(tests: Sequence[Test]) -> ModalData:
    """Return the modes of all tests, labelled ``"test: mode"``, as `StackedData` if a test was repeated.

    It has shapes only if all tests have shapes at the same sensors, and shape standard deviations only if all
    tests have these too. Tests without a mode in use get or lose frequency uncertainty so that they match the
    others.

    Raises
    ------
    TestsError
        If only some of the tests with a mode in use have frequency standard deviations or a covariance matrix. If
        no test has a mode in use, all tests are compared.
    """
    every = _alike([test.data for test in tests])
    sd = covariance = None
    if any(data.covariance_hz2 is not None for data in every):
        covariance = block_diag(*(_covariance(data) for data in every))
    elif every[0].sd_hz is not None:
        sd = np.concatenate([np.asarray(data.sd_hz) for data in every])
    has_shapes = all(data.shapes is not None and data.sensors == every[0].sensors for data in every)
    shapes_sd = None
    if has_shapes and all(data.shapes_sd is not None for data in every):
        shapes_sd = np.concatenate([np.asarray(data.shapes_sd) for data in every], axis=1)
    repeated, freedom = stacked_tests(every), stacked_freedom_of_shapes(every) if shapes_sd is not None else None
    kind: Callable[..., ModalData] = ModalData
    if repeated is not None or freedom is not None:
        kind = partial(StackedData, repeated=repeated, freedom_of_shapes=freedom)
    return kind(
        np.concatenate([np.asarray(data.frequencies_hz) for data in every]),
        numbers=tuple(number for data in every for number in data.numbers),
        counts_rigid=any(data.counts_rigid for data in every),
        sensors=every[0].sensors if has_shapes else (),
        labels=tuple(f"{test.name}: {label}" for test in tests for label in test.data.labels),
        shapes=np.concatenate([np.asarray(data.shapes) for data in every], axis=1) if has_shapes else None,
        sd_hz=sd,
        covariance_hz2=covariance,
        shapes_sd=shapes_sd,
        use=tuple(used for data in every for used in data.use),
    )


def _alike(every: Sequence[ModalData]) -> list[ModalData]:
    """Return the tests' data, either all with or all without frequency uncertainty, so that they can be stacked.

    Tests without a mode in use, such as those whose modes were picked from FRFs, lose their uncertainty or get a
    default one to match the other tests. Raise TestsError if only some of the tests with a mode in use have
    uncertainties. If no test has a mode in use, raise TestsError if only some of all tests have uncertainties.
    """
    trusts = [data.sd_hz is not None or data.covariance_hz2 is not None for data in every]
    counted = [t for t, data in enumerate(every) if any(data.use)] or list(range(len(every)))
    having, lacking = ([t for t in counted if trusts[t] is has] for has in (True, False))
    if having and lacking:
        raise TestsError([f"tests.{lacking[0]}: must have sd or covariance, as tests.{having[0]} has (got none)"])
    found = []
    for data, trust in zip(every, trusts, strict=True):
        if trust != bool(having):
            sd = PICKED_SD * np.asarray(data.frequencies_hz) if having else None
            data = replace(data, sd_hz=sd, covariance_hz2=None)
        found.append(data)
    return found


def _covariance(data: ModalData) -> FloatArray:
    if data.covariance_hz2 is not None:
        return np.asarray(data.covariance_hz2)
    return np.diag(np.asarray(data.sd_hz) ** 2)


def find_configurations(
    model: Model, tests: Sequence[Test], layout: Layout, of_model: int, options: Mapping[str, Any]
) -> tuple[list[Configuration], Any]:
    """Return the configurations as a list, and the reduced models' tolerance.

    Reduced models are trained here, or read from the cache. The returned tolerance belongs to the last
    configuration; it is None if the model of that configuration is not reduced. The first `of_model` structural
    parameters are parameters of the model.

    Raise TestsError in these cases: the changes or known values of a test do not fit the model, or need matrices
    that the model does not have; tests in one configuration contradict each other; two modes that are paired by
    number have the same number, or the pairing does not follow the numbers or counterparts of the tests; or a
    model that pairs its modes itself does not have the modes of the tests.
    Raise ValueError as `UpdatingProblem.reduced` does.
    """
    keys = [test.configuration for test in tests]
    labels = _labels(tests)
    first_mode = np.cumsum([0, *(test.data.n_modes for test in tests)])
    found, tolerance = [], None
    lower, upper = layout.box()
    for key in dict.fromkeys(keys):
        here = [t for t, other in enumerate(keys) if other == key]
        first = tests[here[0]]
        number = {p.name: j for j, p in enumerate(layout.structural)}
        known = {number[name]: value for name, value in first.known.items()}
        kept = [j for j in range(of_model) if j not in known]
        changed: Any = model
        if first.masses or first.springs or known:
            structure = separable_in(model)
            if structure is None:
                raise TestsError(
                    [f"tests.{here[0]}: changes need a model with matrices (got {type(model).__name__})"]
                )
            try:
                changed = changed_model(structure, first.masses, first.springs, known)
            except ValueError as error:
                raise TestsError([f"tests.{here[0]}.{error}"]) from error
        parameters = [
            over(layout.structural[j], float(lower[here, j].min()), float(upper[here, j].max())) for j in kept
        ]
        data, modes, differ = _together({t: tests[t] for t in here})
        n_sensors = 0 if data.shapes is None else len(data.sensors)
        paired = modal_model_in(changed, n_sensors)
        is_function = paired is None and separable_in(changed) is None
        if differ is not None and (data.shapes is None or options["pairing"] == "index" or paired is not None):
            raise differ
        if (options["pairing"] == "index" and paired is None) or (is_function and data.shapes is None):
            where = {label: t for t in reversed(here) for label in tests[t].data.labels}
            _check_distinct("number", data.numbers, data.labels, [where[label] for label in data.labels])
        if paired is not None and paired.n_modes != len(labels):
            rule = f"must together have the {paired.n_modes} modes of the model, in its order"
            raise TestsError([f"tests: {rule} (got {len(labels)}: {', '.join(labels)})"])
        if paired is not None and list(data.labels) != labels:
            changed = PartialModel(paired, [labels.index(label) for label in data.labels], range(n_sensors))
        try:
            alone = UpdatingProblem.reduced(changed, data, parameters, **options)
        except ArgumentError as error:
            if error.key == "start" and changed is not model:
                rule = f"{error.rule} in test {first.name}"
                raise ArgumentError("start", rule, error.value, error.advice) from None
            if error.key not in ("numbers", "counterparts"):
                raise
            raise TestsError([f"tests.{here[0]}.{error}"]) from error
        if differ is not None and not alone.model.by_shape:  # a function that gives no shapes
            raise differ
        tolerance = alone.tolerance
        distinct, rows = layout.distinct(here, kept)
        of_modes = [tests[t].data.n_modes for t in here]
        found.append(
            Configuration(
                model=alone.model,
                tests=np.array(here),
                distinct=distinct,
                parameters=np.array(kept),
                columns=np.concatenate([np.arange(first_mode[t], first_mode[t + 1]) for t in here]),
                test=np.repeat(np.arange(len(here)), of_modes),
                row=np.repeat(rows, of_modes),
                mode=np.concatenate(modes),
            )
        )
    return found, tolerance


def _labels(tests: Sequence[Test]) -> list[str]:
    """Return the labels of all modes in the tests, in ascending order of the modes' numbers.

    If a label has two numbers or a number two labels, the order is that in which the labels first occur.
    """
    pairs = {pair for test in tests for pair in zip(test.data.labels, test.data.numbers, strict=True)}
    labels = list(dict.fromkeys(label for test in tests for label in test.data.labels))
    is_numbered = len(pairs) == len(labels) == len({number for _, number in pairs})
    return sorted(labels, key=dict(pairs).__getitem__) if is_numbered else labels


def _check_distinct(what: str, values: Sequence[int], labels: Sequence[str], where: Sequence[int]) -> None:
    """Raise TestsError if two modes have the same value of `what`, which is ``"number"`` or ``"counterpart"``.

    `values`, `labels` and `where` have an entry for each mode: the number or counterpart, the label, and the index
    of a test that gives the value.
    """
    later = first_repeated(values)
    if later is None:
        return
    first = values.index(values[later])
    rule = f"mode {labels[later]!r} must not have the {what} of mode {labels[first]!r} in tests.{where[first]}"
    advice = f"give each its own {what} or, if they are one mode, the same label"
    raise TestsError([f"tests.{where[later]}.{what}s: {rule} (got {values[later]} for both); {advice}"])


def _together(of: Mapping[int, Test]) -> tuple[ModalData, list[Any], TestsError | None]:
    """Return one `ModalData` with all modes that occur in the tests, each test's mode indices in it, and an error.

    The error is None unless a mode has two numbers in two tests, at least one of which is only its position in a
    test, as in a test that missed a mode. The caller raises it unless measured shapes pair the modes. The modes
    then have the numbers 1, 2, ….

    The keys of `of` are the indices of the tests among all tests. Frequencies and shapes are means over the tests.
    A mode's standard deviation is the smallest in any test. There are no shapes unless every mode has one, and no
    standard deviations unless every mode has one. If only some of the modes have a counterpart in a test, and no
    test has shapes, the modes of the tests without counterparts have 1, 2, …, as in `ModalData.with_frequencies`.
    Raise TestsError if a mode has different given numbers or counterparts in two tests, if only some of the modes
    have counterparts, or if two modes have the same counterpart.
    """
    tests = list(of.values())
    labels = _labels(tests)
    paired = {label for test in tests if test.data.counterparts for label in test.data.labels}
    by_place = 0 < len(paired) < len(labels) and all(test.data.shapes is None for test in tests)
    modes = [np.array([labels.index(label) for label in test.data.labels]) for test in tests]
    frequencies = np.full((len(tests), len(labels)), np.nan)
    sd = np.full_like(frequencies, np.nan)
    numbers: dict[int, int] = {}
    counterparts: dict[int, int] = {}
    given_in: dict[tuple[str, int], int] = {}
    differ: TestsError | None = None
    sensors = tests[0].data.sensors
    shapes = np.full((len(tests), len(sensors), len(labels)), np.nan)
    shapes_sd = np.full_like(shapes, np.nan)
    for t, (number, test, own) in enumerate(zip(of, tests, modes, strict=True)):
        data = test.data
        frequencies[t, own] = data.frequencies_hz
        if data.sd_hz is not None or data.covariance_hz2 is not None:
            sd[t, own] = np.sqrt(np.diag(_covariance(data)))
        if data.shapes is not None:
            shapes[t][:, own] = data.shapes
        if data.shapes_sd is not None:
            shapes_sd[t][:, own] = data.shapes_sd
        for name, known, given in (
            ("number", numbers, data.numbers),
            ("counterpart", counterparts, data.counterparts or (range(1, data.n_modes + 1) if by_place else ())),
        ):
            for mode, value in zip(own.tolist(), given, strict=False):
                first = given_in.setdefault((name, mode), number)
                if known.setdefault(mode, value) != value:
                    rule = (
                        f"mode {labels[mode]!r} must have the {name} that it has in tests.{first}, {known[mode]}"
                    )
                    if name == "number" and not (data.counts_rigid and of[first].data.counts_rigid):
                        advice = "; by default they are 1, 2, …: if a test missed a mode, give its numbers"
                        differ = differ or TestsError([f"tests.{number}.numbers: {rule} (got {value}){advice}"])
                        continue
                    raise TestsError([f"tests.{number}.{name}s: {rule} (got {value})"])
    lacking = [k for k in range(len(labels)) if counterparts and k not in counterparts]
    if lacking:
        rule = f"mode {labels[lacking[0]]!r} must have a counterpart, as other modes have"
        raise TestsError([f"tests.{given_in['number', lacking[0]]}.counterparts: {rule} (got none)"])
    of_modes = tuple(counterparts[k] for k in range(len(labels))) if counterparts else ()
    _check_distinct("counterpart", of_modes, labels, [given_in["counterpart", k] for k in range(len(of_modes))])
    seen = ~np.isnan(shapes).all(axis=(0, 1))
    has_shapes = bool(len(sensors)) and bool(seen.all())
    has_sd = has_shapes and not np.isnan(shapes_sd).all(axis=0).any()
    data = ModalData(
        np.nanmean(frequencies, axis=0),
        numbers=() if differ else tuple(numbers[k] for k in range(len(labels))),
        counts_rigid=any(test.data.counts_rigid for test in tests),
        sensors=sensors,
        labels=tuple(labels),
        # accept any MAC: `fmu.check` and the verdict on a run name the sensors and modes that disagree
        shapes=mean_shapes(shapes, least_mac=0.0) if has_shapes else None,
        shapes_sd=np.nanmin(shapes_sd, axis=0) if has_sd else None,
        sd_hz=None if np.isnan(sd).all(axis=0).any() else np.nanmin(sd, axis=0),
        counterparts=of_modes,
    )
    return data, modes, differ
