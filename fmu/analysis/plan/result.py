"""The result of `fmu.plan`: the sensors, the expected information, and objections to the plan."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.plan.before import Before
from fmu.analysis.plan.design import Design
from fmu.analysis.plan.model_errors import doubts_of_errors
from fmu.analysis.plan.options import AGAIN, enough_repeats
from fmu.analysis.plan.pairing import MOST_WRONG, Pairing
from fmu.analysis.plan.sensitivities import SHAPE_ERROR
from fmu.analysis.plan.sensors.baselines import auto_mac, largest_off_diagonal
from fmu.analysis.plan.sensors.bound import relax
from fmu.analysis.plan.sensors.choice import Limits
from fmu.analysis.plan.sensors.information import Readings
from fmu.analysis.plan.targets import Decision, with_probabilities_in_words
from fmu.fem.modes.separable import SeparableModel
from fmu.numbers import fixed, names_in_words, share, significant
from fmu.posterior.problem import UpdatingProblem
from fmu.tables import data_frame, text_table, wrap_text
from fmu.types import Dof, FloatArray

if TYPE_CHECKING:
    import pandas as pd

PLANNED = "this plan"
_BOUNDS, _STEPS = 8, 24  # numbers of sensors whose bound is computed, and steps of each
_NOT_OF_FRFS = (
    "The plan is of a test that measures modes: it ignores frequency response functions, and damping with them."
)
UNKNOWN = 0.9
"""A parameter remains unknown if its expected sd is above this fraction of its sd before the test."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan of a modal test.

    Attributes
    ----------
    before : Before
        State of knowledge before the test.
    structure : SeparableModel or None
        Structure in the planned test; None for a model without matrices.
    design : Design
        Derivatives, candidates and errors.
    limits : Limits
    chosen : tuple of int
        Chosen candidates, the most important first; the mounted ones are in `limits`.
    usual : dict of str to tuple of int
        Choices made by the customary rules.
    places : ndarray, shape (n_candidates, 3), m, or None
        Coordinates of the candidates; None if they are unknown.
    place_names : mapping of place to str
        Names of places in tables and files.
    information : float
        Expected information gain in nats, about the target or, without one, about all parameters.
    bound : float
        Upper bound, in nats, on the information of any choice of `limits.count` sensors or, with a budget, of any
        choice within the budget.
    curve : DataFrame
        ``information`` of the mounted sensors and the first n chosen ones, one row per n from 0.
    choices : DataFrame
        One row for the plan, one for the most informative choice if this is not the plan, and one for each
        customary choice. The columns are ``information``; ``median_sd``, the median over the parameters of the
        expected standard deviation relative to its value before the test; ``largest_auto_mac`` off the diagonal;
        ``wrong_pairs``, the largest fraction of wrong pairings of any mode; for a decision about damage, also
        ``if_none`` and ``if_twice`` (`Decision.worst`).
    modes, repeats, second_tests : DataFrame
        See `fmu.analysis.plan.options`; `second_tests` is None without changes.
    pairing : Pairing
    drift : float
        Relative standard deviation of the frequencies that repeats do not reduce.
    decision : Decision or None
        Decision about damage that the test has to support.
    """

    before: Before
    structure: SeparableModel | None
    design: Design
    limits: Limits
    chosen: tuple[int, ...]
    usual: Mapping[str, tuple[int, ...]]
    places: FloatArray | None
    place_names: Mapping[Any, str]
    information: float
    bound: float
    curve: pd.DataFrame
    choices: pd.DataFrame
    modes: pd.DataFrame
    repeats: pd.DataFrame
    second_tests: pd.DataFrame | None
    pairing: Pairing
    drift: float
    decision: Decision | None = None

    @property
    def problem(self) -> UpdatingProblem:
        """The problem whose next test is planned."""
        return self.before.problem

    @property
    def every(self) -> tuple[int, ...]:
        """Candidates measured in the test: the mounted ones, then the chosen ones."""
        return (*self.limits.mounted, *self.chosen)

    @property
    def sensors(self) -> tuple[Dof, ...]:
        """Channels (place, direction) of the test: the mounted ones, then the chosen ones by importance."""
        there = self.design.candidates
        return tuple(there.sensors[row] for row in there.rows(self.every))

    @property
    def named_sensors(self) -> tuple[Dof, ...]:
        """`sensors`, with each place replaced by its name where it has one."""
        return tuple((self.place_names.get(place, place), direction) for place, direction in self.sensors)

    @property
    def gap(self) -> float:
        """Upper bound on the fraction of the best possible information that the plan misses."""
        return (self.bound - self.information) / self.bound if self.bound > 0.0 else 0.0

    @property
    def frequency_sd(self) -> FloatArray:
        """Relative standard deviation of each measured frequency, including drift, shape (n_modes,)."""
        return np.sqrt(self.design.frequency_sd**2 + self.drift**2)

    @property
    def auto_mac(self) -> FloatArray:
        """AutoMAC of the measured modes at the sensors, at the reference parameters, (n_modes, n_modes)."""
        shapes = self.design.found.nominal.shapes[0][:, list(self.design.modes)]
        return auto_mac(shapes, self.design.candidates.rows(self.every))

    def parameters(self) -> pd.DataFrame:
        """Return a table of expected standard deviations in SI units, one row per parameter.

        The columns are the standard deviations before the test (``before``), after a measurement of the
        frequencies alone (``frequencies``), and after the whole test (``after``).
        """
        readings = self.design.readings(frequency_sd=self.frequency_sd)
        columns = {
            "before": self.design.prior_sd,
            "frequencies": self.design.sd_of(readings.start()),
            "after": self.design.sd_of(readings.with_sensors(self.every)),
        }
        return data_frame(columns, "parameter", self.design.names)

    def losses(self) -> pd.DataFrame | None:
        """Return the table of losses from `Decision.expect`, or None if the target is not damage."""
        if self.decision is None or self.design.target is None:
            return None
        readings = self.design.readings(frequency_sd=self.frequency_sd)
        return self.decision.expect(self.design.target, readings.with_sensors(self.every))

    def with_bounds(self) -> pd.DataFrame:
        """Return `curve` with a column ``bound``, an upper bound on the information from any choice of that size.

        The bound is computed for up to eight numbers of sensors and is NaN for the others. With a budget, which
        does not fix the number of sensors, it is NaN everywhere.
        """
        found, n = self.curve.copy(), len(self.chosen)
        bounds = np.full(n + 1, np.nan)
        if np.isfinite(self.limits.budget):
            return found.assign(bound=bounds)
        readings = self.design.readings(frequency_sd=self.frequency_sd)
        for k in np.unique(np.linspace(min(2, n), n, _BOUNDS).astype(int)):
            relaxed = relax(readings, replace(self.limits, count=int(k)), _STEPS) if k < n else None
            bounds[k] = self.bound if relaxed is None else relaxed.bound
        return found.assign(bound=bounds)

    def sensor_table(self) -> pd.DataFrame:
        """Return a table with one row per channel.

        The columns are the sensor, place, direction, coordinates in m if known, and ``mounted``.
        """
        there, named = self.design.candidates, iter(self.named_sensors)
        rows: list[dict[str, object]] = []
        for number, k in enumerate(self.every, 1):
            for _ in there.rows([k]):
                place, direction = next(named)
                one: dict[str, object] = {"sensor": number, "place": place, "direction": direction}
                if self.places is not None:
                    one |= dict(zip("xyz", self.places[k].tolist(), strict=True))
                rows.append(one | {"mounted": k in self.limits.mounted})
        return data_frame(rows, "channel", range(1, len(rows) + 1))

    @property
    def shared_by_repeats(self) -> str:
        """Sentence on the values that repeats do not draw anew; empty if no parameter forms a population."""
        names = names_in_words(list(self.problem.layout.populations))
        if not names:
            return ""
        return (
            f"Repeats are on the same day, with the same {names}; tests on other days, with new values, are not "
            "in the table of repeats."
        )

    @property
    def doubts(self) -> tuple[str, ...]:
        """Objections to the plan, one sentence each; the plan is recommended if there are none."""
        found, sd = [*self.before.doubts, *doubts_of_errors(self.before)], self.parameters()
        for i, wrong in enumerate(self.pairing.wrong):
            if wrong > MOST_WRONG:
                mode, other = self.design.modes[i] + 1, int(self.pairing.taken_for[i]) + 1
                found.append(
                    f"In {share(wrong)} of the simulated tests mode {mode} is paired with another mode, most "
                    f"often with mode {other}. Take more sensors, or leave mode {mode} out."
                )
        certificate = self.design.found.certificate
        if certificate is not None and not certificate.ok:
            found.append(
                f"Shapes of the reduced model err by {significant(certificate.shape, 2)} of their largest "
                f"component (allowed: {significant(SHAPE_ERROR, 1)}); narrow the bounds."
            )
        if np.all(sd["after"] > UNKNOWN * sd["before"]):
            found.append("The test tells little about any parameter: measure more accurately, or more modes.")
        return tuple(found)

    @property
    def recommended(self) -> bool:
        """Whether there are no objections to the plan."""
        return not self.doubts

    def sentences(self) -> list[str]:
        """Return sentences on the information that the plan is expected to give."""
        sd = self.parameters()
        ratio = sd["after"] / sd["before"]
        unknown = [str(name) for name, one in ratio.items() if one > UNKNOWN]
        mounted = f" and the {len(self.limits.mounted)} mounted" if self.limits.mounted else ""
        within = "of as many" if np.isinf(self.limits.budget) else "within the budget"
        said = [
            f"{len(self.chosen)} sensors{mounted} are expected to give {fixed(self.information, 2)} nats of "
            f"information. No other choice {within} gives more than {fixed(self.bound, 2)} nats: the plan is "
            f"within {share(self.gap)} of the best.",
            f"The expected standard deviation of a parameter is {share(float(ratio.min()))} to "
            f"{share(float(ratio.max()))} of the one before the test; with frequencies alone "
            f"{share(float((sd['frequencies'] / sd['before']).min()))} to "
            f"{share(float((sd['frequencies'] / sd['before']).max()))}.",
        ]
        if self.problem.likelihood.responses:
            said.insert(0, _NOT_OF_FRFS)
        if unknown:
            said.append(f"Nearly unknown after the test: {names_in_words(unknown)}.")
        losses = self.losses()
        if self.decision is not None and losses is not None:
            said += self.decision.sentences(losses)
        enough = enough_repeats(self.repeats)
        said.append(
            "Repeats go on reducing the standard deviations."
            if enough is None
            else "A repeat of the test would change little."
            if enough == 1
            else f"More than {enough} tests would change little."
        )
        if self.shared_by_repeats:
            said.append(self.shared_by_repeats)
        if self.second_tests is not None:
            gain = self.second_tests["gain"]
            best = str(gain.index[0])
            said.append(
                "No change of the structure tells more than the same test again."
                if best == AGAIN
                else f"The second test that tells most: {best}, {fixed(gain.iloc[0], 2)} nats more (the same test "
                f"again: {fixed(gain[AGAIN], 2)})."
            )
        said += self._origin()
        return said

    def _origin(self) -> list[str]:
        found = self.design.found
        n = len(found.seen.frequencies)
        said = [f"Linearised at {n} draws with {found.n_solves} solves."]
        if found.kept is not None:
            said.append(f"{int(np.sum(~found.kept))} draws were left out, as their modes have no derivative.")
        if found.certificate is not None:
            c = found.certificate
            said.append(
                f"A reduced model of {c.size} unknowns gave them. At {c.draws} draws its shapes differ from those "
                f"of the full model by at most {significant(c.shape, 2)} of their largest component."
            )
        return said

    def __str__(self) -> str:
        verdict = "Recommended." if self.recommended else "Not recommended."
        parts = [wrap_text(one) for one in (verdict, *self.doubts, *self.sentences())]
        losses = self.losses()
        tables: tuple[tuple[str, pd.DataFrame | None], ...] = (
            ("Sensors", self.sensor_table()),
            ("Expected standard deviations, SI units", self.parameters()),
            ("Losses", None if losses is None else with_probabilities_in_words(losses)),
            ("Choices", with_probabilities_in_words(self.choices)),
            ("Modes", self.modes),
            ("Repeats", self.repeats),
            ("Second tests", self.second_tests),
        )
        for title, table in tables:
            if table is not None:
                rows = [
                    [str(i), *map(cell, row)]
                    for i, row in zip(table.index, table.itertuples(index=False), strict=True)
                ]
                parts += [f"\n{title}", text_table([str(table.index.name), *map(str, table.columns)], rows)]
        return "\n".join(parts)

    def _repr_html_(self) -> str:
        said = "".join(f"<p>{html.escape(one)}</p>" for one in (*self.doubts, *self.sentences()))
        return said + str(self.sensor_table().to_html()) + str(self.parameters().to_html(float_format=significant))


def cell(value: object) -> str:
    """Format a table cell: a float with significant digits, True as ``"yes"``, False as an empty string."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else ""
    return significant(float(value)) if isinstance(value, float) else str(value)


def choice_row(
    design: Design, readings: Readings, every: Sequence[int], pairing: Pairing, decision: Decision | None
) -> dict[str, float]:
    """Return the row of `Plan.choices` that describes one choice of candidates."""
    state, rows = readings.with_sensors(every), design.candidates.rows(every)
    shapes = design.found.nominal.shapes[0][:, list(design.modes)][rows]
    expected = {} if decision is None or design.target is None else decision.worst(design.target, state)
    return {
        "information": readings.value(state),
        **expected,
        "median_sd": float(np.median(design.sd_of(state) / design.prior_sd)),
        "largest_auto_mac": float(largest_off_diagonal(shapes.T @ shapes)),
        "wrong_pairs": float(np.max(pairing.wrong)),
    }


def information_curve(readings: Readings, limits: Limits, chosen: Sequence[int]) -> pd.DataFrame:
    """Return a table of the information from the mounted and the first n chosen sensors, one row per n from 0."""
    state = readings.with_sensors(limits.mounted)
    values = [readings.value(state)]
    for k in chosen:
        state = readings.with_sensors([k], state)
        values.append(readings.value(state))
    return data_frame({"information": np.array(values)}, "sensors", range(len(values)))
