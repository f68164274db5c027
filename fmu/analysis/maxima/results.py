"""The maxima found for a posterior: positions, masses, tables, and storage in a trace."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.maxima.kinds import KINK, MAXIMUM, SINGULARITY, are_negligible, basin, why_no_maximum
from fmu.analysis.trace.provenance import configuration_hash
from fmu.numbers import apart, customary_unit, given, hertz, round_by_sd, share, with_unit
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.tables import data_frame, distinct, text_table, wrap_text
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


TYPICAL_POINT = {"maxima": "typical point"}
"""Entry in a run's configuration for chains that start at the typical point of a hierarchical posterior."""
MOST_SHOWN = 6
"""Largest number of maxima shown side by side."""
_PROBABLE = ("log-probability", "share of probability", "starts")
NEGLIGIBLE = 0.01
"""Probability share up to which a maximum is negligible, so that a run may miss it."""
RELIABLE = 20.0
"""ESS that a maximum's mass needs to be reliable."""


def share_of_mass(part: float) -> str:
    """Format a maximum's posterior probability as a percentage, never as zero even if it underflows."""
    return share(max(part, np.finfo(float).tiny))


def mass_in_words(part: float) -> str:
    """Describe a posterior probability in words: ``"about 3 %"``, ``"less than 0.01 %"``."""
    text = share_of_mass(part)
    return text.replace("< ", "less than ").replace("> ", "more than ") if text[0] in "<>" else f"about {text}"


def theta_in_words(
    names: Iterable[str], theta: FloatArray, units: Iterable[str], sd: FloatArray | None = None
) -> str:
    """Format a parameter vector: ``"Ix1 = 3904 mm⁴, Ax1 = 900.0 mm²"``; `sd` determines the digits."""
    spread = np.zeros(len(theta)) if sd is None else np.nan_to_num(sd)
    parts = zip(names, theta, spread, units, strict=True)
    return ", ".join(f"{name} = {with_unit(float(x), unit, float(s))}" for name, x, s, unit in parts)


@dataclass(frozen=True, eq=False)
class PosteriorMaximum:
    """A local maximum of the posterior within the bounds, or another point where an ascent ended, in SI units.

    Attributes
    ----------
    theta : ndarray, shape (ndim,)
    log_prob : float
        Log-probability, as returned by ``problem.log_prob``.
    frequencies : ndarray, shape (n_modes,)
        Computed frequencies in Hz, paired with the measured modes; empty for a plain log-density.
    starts : int
        Number of starting points from which the optimiser reached this maximum.
    at_bound : ndarray of int, shape (ndim,)
        −1 where the lower bound is active, 1 where the upper bound is active, otherwise 0.
    gradient : ndarray, shape (ndim,)
        Gradient of the log-probability; not zero across an active bound, or at a point that is no smooth maximum.
    hessian : ndarray, shape (ndim, ndim)
        −∇² log P or an approximation.
    curvature : str
        Source of the Hessian: ``"differences"`` of the gradient, or ``"Gauss-Newton"``.
    mean, sd : ndarray, shape (ndim,)
        Mean and standard deviation over the part of the posterior that belongs to this maximum.
    log_mass : float
        Logarithm of the integral ∫ P(D|θ) P(θ) dθ over this part; −inf if the maximum is too low to matter.
    effective_draws : float
        ESS of `mean`, `sd` and `log_mass`; 0 if they come from the Laplace approximation alone.
    share : float
        This mass divided by the total mass of all maxima found.
    kind : str
        ``"maximum"`` if the gradient vanishes, except across active bounds; ``"kink"`` if the gradient changes
        sign; ``"jump"`` if log P falls abruptly; ``"edge"`` if the model has no solution beyond the point;
        ``"singularity"`` beside a bound where P is infinite; ``"slope"`` if the search ended without a maximum.
    slope : float
        Length of the gradient over the free coordinates, in nats per posterior standard deviation.
    weight : float
        Fraction of the chains that start here. It is proportional to the mass that the quadratic model covers,
        even across a jump. If it is NaN, `share` is used instead.
    evidence_covariance : float
        Covariance of the errors of `log_mass` and of the log-evidence; NaN if unknown.
    """

    theta: FloatArray
    log_prob: float
    frequencies: FloatArray
    starts: int
    at_bound: IntArray
    gradient: FloatArray
    hessian: FloatArray
    curvature: str
    mean: FloatArray
    sd: FloatArray
    log_mass: float
    effective_draws: float
    share: float
    kind: str = MAXIMUM
    slope: float = 0.0
    weight: float = np.nan
    evidence_covariance: float = np.nan

    @property
    def is_maximum(self) -> bool:
        """Whether this point is a maximum or a kink, from which log P rises in no direction."""
        return self.kind in (MAXIMUM, KINK)

    @property
    def starting_share(self) -> float:
        """Fraction of the chains that start at this maximum."""
        return self.share if np.isnan(self.weight) else self.weight


@dataclass(frozen=True, eq=False)
class Maxima:
    """The local maxima found, the highest first; a sequence of `PosteriorMaximum`.

    Attributes
    ----------
    maxima : tuple of PosteriorMaximum
    names, units : tuple of str
        Parameter names and units.
    labels : tuple of str
        Labels of the measured modes.
    lower, upper, start : ndarray, shape (ndim,)
        Bounds, and parameters of the model before updating.
    measured, before : ndarray, shape (n_modes,)
        Measured frequencies, and frequencies of the model before updating, Hz.
    n_solves, n_gradients : int
        Number of model solves for the search and the masses, and how many of them had an exact gradient; 0 if
        unknown.
    search : str
        For a plain density: where the search began and what it found, in words. Empty for an updating problem.
    doubts : tuple of str
        Reasons why the search does not exclude other maxima, one sentence each; empty if it excludes them as far
        as a search can.
    level : float
        Third-highest log-density at points scattered over the region in which a plain density was searched. If
        draws lie above this level, the points are too sparse to find other modes as narrow as the draws' own.
        Infinite for an updating problem.
    """

    maxima: tuple[PosteriorMaximum, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    start: FloatArray
    measured: FloatArray
    before: FloatArray
    n_solves: int = 0
    n_gradients: int = 0
    search: str = ""
    doubts: tuple[str, ...] = ()
    level: float = np.inf

    def __iter__(self) -> Iterator[PosteriorMaximum]:
        return iter(self.maxima)

    def __len__(self) -> int:
        return len(self.maxima)

    def __getitem__(self, index: int) -> PosteriorMaximum:
        return self.maxima[index]

    @property
    def log_evidence(self) -> float:
        """Log of the maxima's total mass, which estimates log P(D) if all maxima were found."""
        return float(np.logaddexp.reduce([m.log_mass for m in self.maxima]))

    @property
    def effective_draws(self) -> float:
        """Smallest ESS of the mass estimates. Negligible maxima are ignored; 0 if all are negligible."""
        return min((m.effective_draws for m in self.maxima if m.share > NEGLIGIBLE), default=0.0)

    @property
    def are_weighed(self) -> bool:
        """Whether the masses of the maxima are reliable.

        Every point with more than 1 % of the mass must be a maximum or a kink, and `effective_draws` must be at
        least `RELIABLE`.
        """
        return self.effective_draws >= RELIABLE and all(m.is_maximum for m in self.maxima if m.share > NEGLIGIBLE)

    @property
    def are_singular(self) -> bool:
        """Whether a density that is infinite at a bound may matter; no mass of any maximum is then reliable."""
        return any(m.kind == SINGULARITY and max(m.share, m.starting_share) > NEGLIGIBLE for m in self.maxima)

    @property
    def log_evidence_error(self) -> float:
        """Standard error of `log_evidence` from the importance weights; NaN if no mass comes from such weights.

        Its square is the mean of all `evidence_covariance`, weighted by the shares. For one that is NaN, in a
        trace of an older version, share divided by ESS is taken, which is mostly too large.
        """
        weighed = [m for m in self.maxima if m.effective_draws > 0]
        if not weighed:
            return np.nan
        share, ess, covariance = np.array([(m.share, m.effective_draws, m.evidence_covariance) for m in weighed]).T
        return float(np.sqrt(max(share @ np.where(np.isnan(covariance), share / ess, covariance), 0.0)))

    @property
    def hash(self) -> str:
        """SHA-256 hash of the maxima's positions, log-probabilities, gradients, Hessians and starting shares."""
        what = {
            name: [vars(m)[name] for m in self.maxima] for name in ("theta", "log_prob", "gradient", "hessian")
        }
        return configuration_hash(what | {"share": [m.starting_share for m in self.maxima]})

    def table(self) -> pd.DataFrame:
        """Return a table with one row per maximum, SI units.

        The columns are ``log_prob``, ``share``, ``starts``, ``at_bounds`` (in words); each parameter; its
        posterior mean and standard deviation around this maximum, ``NAME_mean`` and ``NAME_sd``; and the
        frequencies ``LABEL_hz`` in Hz. If a name is already taken, an underscore is added: a parameter called
        ``share`` is in column ``share_``.
        """
        best = self.maxima
        columns: list[tuple[str, Sequence[object]]] = [
            ("log_prob", [m.log_prob for m in best]),
            ("share", [m.share for m in best]),
            ("starts", [m.starts for m in best]),
            ("at_bounds", [self.words_at_bounds(m) for m in best]),
        ]
        columns += [(name, [m.theta[k] for m in best]) for k, name in enumerate(self.names)]
        for k, name in enumerate(self.names):
            columns += [(f"{name}_mean", [m.mean[k] for m in best]), (f"{name}_sd", [m.sd[k] for m in best])]
        columns += [(f"{label}_hz", [m.frequencies[k] for m in best]) for k, label in enumerate(self.labels)]
        names = distinct([name for name, _ in columns])
        content = dict(zip(names, (values for _, values in columns), strict=True))
        table = data_frame(content, "maximum", range(1, len(best) + 1))
        table.attrs["units"] = dict(zip(names[4 : 4 + len(self.names)], self.units, strict=True))
        return table

    def words_at_bounds(self, maximum: PosteriorMaximum) -> str:
        """Return a maximum's active bounds in words, as in ``"Ix2 upper, Ax1 upper"``, or "" if none is active."""
        side = {-1: "lower", 1: "upper"}
        return ", ".join(
            f"{name} {side[int(at)]}" for name, at in zip(self.names, maximum.at_bound, strict=True) if at
        )

    def drop(self, theta: FloatArray) -> FloatArray:
        """Return the drop of each maximum's quadratic model from its peak to theta (n, ndim), shape (maxima, n).

        The drop is infinite for a maximum too low to have mass, because the ascent to it may have ended on a
        slope.
        """
        models = [
            basin(Quadratic(m.theta, m.log_prob, m.gradient, m.hessian), m.kind, m.at_bound) for m in self.maxima
        ]
        falls = np.stack([model.log_prob - model(theta) for model in models])
        falls[are_negligible(np.array([m.log_prob for m in self.maxima]), theta.shape[1])] = np.inf
        return falls

    def side_by_side(self, most: int = MOST_SHOWN) -> pd.DataFrame:
        """Return a text table that compares the maxima, the model before updating and the data, one column each.

        The posterior standard deviations determine the number of digits. Frequencies that differ have enough
        digits to tell them apart.

        Parameters
        ----------
        most : int
            Number of maxima shown, the highest first.
        """
        import pandas as pd

        best = self.maxima[:most]
        rows = [
            ["", "", *(round_by_sd(m.log_prob, 1.0) for m in best), ""],
            ["", "", *("unknown" if self.are_singular else share_of_mass(m.share) for m in best), ""],
            ["", "", *(str(m.starts) for m in best), ""],
        ]
        for k, (factor, unit) in enumerate(map(customary_unit, self.units)):
            sd = min((float(m.sd[k]) for m in best if m.share > NEGLIGIBLE and m.sd[k] > 0), default=np.nan)
            values = (float(x[k]) / factor for x in (self.start, *(m.theta for m in best)))
            rows.append([unit, *apart(*values, sd=sd / factor), ""])
        for k in range(len(self.labels)):
            hz = (float(f[k]) for f in (self.before, *(m.frequencies for m in best)))
            rows.append(["Hz", *hertz(*hz, measured=self.measured[k]), given(self.measured[k])])
        index = [*_PROBABLE, *self.names]
        index += [f"mode {label}" for label in self.labels]
        header = ["unit", "before", *(self.title(k) for k in range(len(best))), "measured"]
        return pd.DataFrame(rows, index=index, columns=header)

    def at_bounds(self) -> list[str]:
        """Return a sentence on each maximum with an active bound, among the `MOST_SHOWN` highest."""
        words = [self.words_at_bounds(m) for m in self.maxima[:MOST_SHOWN]]
        titles = [self.title(k).capitalize() for k in range(len(words))]
        return [f"{title} lies at bounds: {said}." for title, said in zip(titles, words, strict=True) if said]

    def title(self, k: int) -> str:
        """Return the title of maximum `k`, such as ``"maximum 1"``, or ``"jump 2"`` if it is not a maximum."""
        return f"{self.maxima[k].kind if not self.maxima[k].is_maximum else MAXIMUM} {k + 1}"

    def no_maxima(self) -> list[str]:
        """Return a sentence on each point that is not a maximum, among the `MOST_SHOWN` highest."""
        return [
            f"{self.title(k).capitalize()} is no maximum: "
            + why_no_maximum(m.kind, m.slope, "prior's " if self.labels else "")
            for k, m in enumerate(self.maxima[:MOST_SHOWN])
            if not m.is_maximum
        ]

    def as_text(self, most_rows: int | None = None) -> str:
        """Return the table as text, or only the maxima's probabilities if it has more than `most_rows` rows.

        Sentences on points that are no maxima and on active bounds follow.
        """
        table = self.side_by_side()
        if most_rows is not None and len(table) > most_rows:
            table = table.iloc[: len(_PROBABLE), 2:-1]
        header = ["", *(str(name).removeprefix(f"{MAXIMUM} ") for name in table.columns)]
        rows = [[str(name), *row] for name, row in zip(table.index, table.to_numpy().tolist(), strict=True)]
        words = [i for i, name in enumerate(header) if name in ("", "unit")]
        lines = [text_table(["maximum", *header[1:]], rows, words=words)]
        return "\n".join([*lines, *(wrap_text(said, others="  ") for said in self.no_maxima() + self.at_bounds())])

    def __str__(self) -> str:
        return self.as_text()

    def _repr_html_(self) -> str:
        said = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in self.no_maxima() + self.at_bounds())
        return str(self.side_by_side().to_html()) + said

    def to_dataset(self) -> xr.Dataset:
        """Return the maxima as a dataset that a trace can store."""
        import xarray as xr

        return xr.Dataset(
            {
                name: (("maximum", *dims), np.array([vars(m)[name] for m in self.maxima]))
                for name, dims in _DIMENSIONS.items()
            }
            | {name: ("parameter", vars(self)[name]) for name in ("lower", "upper", "start")}
            | {name: ("mode", vars(self)[name]) for name in ("measured", "before")}
            | {name: ((), vars(self)[name]) for name in _COUNTS},
            coords={
                "maximum": np.arange(1, len(self) + 1),
                "parameter": list(self.names),
                "mode": list(self.labels),
                "unit": ("parameter", list(self.units)),
            },
            attrs={"search": self.search, "doubts": json.dumps(self.doubts), "level": self.level}
            if self.search or self.doubts
            else {},
        )

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Maxima:
        """Restore the maxima from a dataset that `to_dataset` returned."""
        columns = {name: dataset[name].to_numpy() for name in _DIMENSIONS if name in dataset}
        rows = [{name: column[i] for name, column in columns.items()} for i in range(dataset.sizes["maximum"])]
        names, units, labels = (
            tuple(map(str, dataset[name].to_numpy())) for name in ("parameter", "unit", "mode")
        )
        vectors = ("lower", "upper", "start", "measured", "before")
        others: dict[str, Any] = {name: dataset[name].to_numpy() for name in vectors}
        others |= {name: int(dataset[name]) for name in _COUNTS if name in dataset}
        if "search" in dataset.attrs:
            others |= {"search": dataset.attrs["search"], "level": float(dataset.attrs["level"])}
            others["doubts"] = tuple(json.loads(dataset.attrs["doubts"]))
        return cls(tuple(PosteriorMaximum(**row) for row in rows), names, units, labels, **others)


_COUNTS = ("n_solves", "n_gradients")
_DIMENSIONS: dict[str, tuple[str, ...]] = {
    "theta": ("parameter",),
    "log_prob": (),
    "frequencies": ("mode",),
    "starts": (),
    "at_bound": ("parameter",),
    "gradient": ("parameter",),
    "hessian": ("parameter", "parameter_"),
    "curvature": (),
    "mean": ("parameter",),
    "sd": ("parameter",),
    "log_mass": (),
    "effective_draws": (),
    "share": (),
    "kind": (),
    "slope": (),
    "weight": (),
    "evidence_covariance": (),
}
