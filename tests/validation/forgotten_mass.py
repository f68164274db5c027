"""Why do intervals with scatter over the modes cover fewer moduli if the model lacks a mass? A linear model.

    python -m tests.validation.forgotten_mass OUT [--kept DIRECTORY] [--minutes M]

The structures are the beams of `tests.validation.wrong_beam`, with frequencies linearised in all values. The
posterior of the moduli is then Gaussian for given standard deviations τ of the scatter. τ is integrated out over
points of its prior, without chains. The page is forgotten-mass.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.stats import halfnorm, norm, qmc

from fmu.numbers import MISSING, fixed, share
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation.kept import Units, fields_of, study_parser
from tests.validation.wrong_beam import (
    ERRORS,
    FORGOTTEN,
    HELD,
    MODES,
    PRIOR_SD,
    SIZES,
    SOFT,
    THICKNESS,
    frequencies,
)

STRUCTURES, SEED, POINTS = 1000, 20_311, 9
"""Number of structures in each row, their seed, and the binary logarithm of the number of prior points of τ."""
STEP = 1e-4


class Allowance(NamedTuple):
    """The values for whose errors a model allows.

    Attributes
    ----------
    words : str
    scattered, updated : tuple of str
        The values of `HELD` that scatter over the modes, and those that are updated like the moduli.
    wider : float
        Factor on the standard deviations of the priors of τ.
    tau : float or None
        τ, if it is known.
    correlation : float or None
        Correlation of each scatter over the modes; None to infer one for each scatter.
    twice : bool
        Whether each value has two scatters, an independent one and one in common, each with its own τ.
    """

    words: str
    scattered: tuple[str, ...] = ()
    updated: tuple[str, ...] = ()
    wider: float = 1.0
    tau: float | None = None
    correlation: float | None = 0.0
    twice: bool = False


EVERY = (
    Allowance("nothing"),
    Allowance("scatter of all three", HELD),
    Allowance("scatter of all three, correlations inferred", HELD, correlation=None),
    Allowance("two scatters of all three, independent and in common", HELD, twice=True),
)
ROWS = (
    *((kind, allowance) for kind in ("right", "joint", "thickness", "mass") for allowance in EVERY),
    ("right", Allowance("scatter of all three, in common", HELD, correlation=1.0)),
    ("mass", Allowance("scatter of all three, in common", HELD, correlation=1.0)),
    ("mass", Allowance("scatter of all three, priors of τ 4 times as wide", HELD, wider=4.0)),
    ("mass", Allowance("scatter of the mass", ("mass",))),
    ("mass", Allowance("scatter of the mass, τ = 4 % known", ("mass",), tau=0.04)),
    ("mass", Allowance("scatter of the mass, τ = 16 % known", ("mass",), tau=0.16)),
    ("mass", Allowance("an updated mass", updated=("mass",))),
    ("mass", Allowance("three updated values", updated=HELD)),
    ("right", Allowance("three updated values", updated=HELD)),
)


@dataclass(frozen=True)
class Row:
    """Coverage of the intervals of both moduli, mean posterior sd, mean error of E1, rms error, and median τ."""

    held: float
    sd: float
    mean_error: float
    rms_error: float
    tau: list[float] = field(default_factory=list)


def slopes() -> tuple[FloatArray, FloatArray]:
    """Return the relative derivatives of the frequencies by the moduli (MODES, 2) and by `HELD` (MODES, 3)."""
    one = np.ones(2)
    pairs = [(frequencies(one + STEP * x), frequencies(one - STEP * x)) for x in np.eye(2)]
    pairs += [(frequencies(one, **{name: 1.0 + STEP}), frequencies(one, **{name: 1.0 - STEP})) for name in HELD]
    found = np.stack([(up - down) / (2.0 * STEP) for up, down in pairs], axis=1) / frequencies(one)[:, None]
    return found[:, :2], found[:, 2:]


def measured(rng: np.random.Generator, kind: str, E: FloatArray, S: FloatArray) -> tuple[FloatArray, ...]:
    """Return relative changes of the true moduli and of the measured frequencies, and the sd of the errors."""
    moduli, sd = PRIOR_SD * rng.standard_normal(2), np.exp(rng.uniform(*np.log(ERRORS), MODES))
    size = {
        "joint": -rng.uniform(*SOFT),
        "thickness": rng.choice([-1.0, 1.0]) * THICKNESS,
        "mass": rng.uniform(*FORGOTTEN),
        "right": 0.0,
    }[kind]
    wrong = size * S[:, HELD.index(kind)] if size else 0.0
    return moduli, E @ moduli + wrong + sd * rng.standard_normal(MODES), sd


def _scatters(allowance: Allowance) -> tuple[FloatArray, FloatArray]:
    """Return prior points of each value's independent scatter and of its scatter in common, (k, q) each.

    For one scatter τ with the correlation ρ, they are √(1 − ρ) τ and √ρ τ.
    """
    q = len(allowance.scattered)
    if not q:
        return np.zeros((1, 0)), np.zeros((1, 0))
    inferred = allowance.correlation is None
    more = inferred or allowance.twice
    u = qmc.Sobol(q * (1 + more), rng=np.random.default_rng(SEED)).random_base2(POINTS + 2 * more)
    sizes = allowance.wider * np.array([SIZES[name] for name in allowance.scattered])
    tau = sizes * halfnorm.ppf(u[:, :q]) if allowance.tau is None else np.array([[allowance.tau]])
    if allowance.twice:
        return tau, sizes * halfnorm.ppf(u[:, q:])
    rho = u[:, q:] if inferred else np.full(tau.shape, allowance.correlation)
    return np.sqrt(1.0 - rho) * tau, np.sqrt(rho) * tau


def updated(kind: str, allowance: Allowance) -> Row:
    """Simulate structures with an error of the model of this kind, and return the result of their updating."""
    rng, (E, S) = np.random.default_rng(SEED), slopes()
    scattered, new = ([HELD.index(name) for name in names] for names in (allowance.scattered, allowance.updated))
    independent, common = _scatters(allowance)
    tau, own = np.hypot(independent, common), independent**2 @ S[:, scattered].T ** 2
    fixed_columns = np.broadcast_to(np.hstack([E, S[:, new]]), (len(tau), MODES, 2 + len(new)))
    A = np.concatenate([fixed_columns, S[:, scattered] * common[:, None]], axis=2)
    precision = np.diag(
        1.0 / np.array([PRIOR_SD, PRIOR_SD, *(SIZES[HELD[k]] for k in new), *np.ones(len(scattered))]) ** 2
    )
    held, sds, errors, taus = [], [], [], []
    for _ in range(STRUCTURES):
        moduli, y, sd = measured(rng, kind, E, S)
        W = 1.0 / (sd**2 + own)
        weighted = np.swapaxes(W[..., None] * A, 1, 2)
        H, b = weighted @ A + precision, weighted @ y
        covariance = np.linalg.inv(H)
        mean = np.einsum("kmn,kn->km", covariance, b)
        log_w = 0.5 * (np.log(W).sum(axis=1) - W @ y**2 + np.sum(mean * b, axis=1) - np.linalg.slogdet(H)[1])
        weight = np.exp(log_w - log_w.max())
        weight /= weight.sum()
        mean, spread = mean[:, :2], np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :2])
        rank, centre = weight @ norm.cdf((moduli - mean) / spread), weight @ mean
        held.append((rank >= 0.05) & (rank <= 0.95))
        sds.append(np.sqrt(weight @ (spread**2 + (mean - centre) ** 2)))
        errors.append(centre - moduli)
        taus.append(weight @ tau)
    off = np.array(errors)
    median = np.median(np.array(taus), axis=0).tolist()
    return Row(
        float(np.mean(held)),
        float(np.mean(sds)),
        float(off[:, 0].mean()),
        float(np.sqrt(np.mean(off**2))),
        median,
    )


def main() -> int:
    """Write the page."""
    asked = study_parser(__doc__).parse_args()
    jobs = [((kind, allowance.words), (kind, allowance)) for kind, allowance in ROWS]
    rows = Units(asked.kept, asked.minutes).completed(
        "rows", jobs, lambda job: updated(*job), fields_of(Row, list)
    )
    found = {(kind, allowance.words): row for (kind, allowance), row in zip(ROWS, rows, strict=False)}
    cells = []
    for (kind, allowance), row in zip(ROWS, rows, strict=False):
        tau = [f"{name} {fixed(100.0 * x, 1)}" for name, x in zip(allowance.scattered, row.tau, strict=True)]
        numbers = [fixed(100.0 * x, 1) for x in (row.sd, row.mean_error, row.rms_error)]
        error = "none" if kind == "right" else kind
        cells.append((error, allowance.words, share(row.held, 3), *numbers, ", ".join(tau)))
    text = PAGE.format(
        structures=STRUCTURES,
        **_numbers(found),
        table=markdown_table(HEADER, cells, words=(0, 1, 6)),
    )
    (asked.out / "forgotten-mass.md").write_text(text, "utf-8")
    return 0


def _numbers(found: Mapping[tuple[str, str], Row]) -> dict[str, str]:
    """Return the numbers of the text, from the rows with a forgotten mass; a dash for a row that is missing."""
    words = {
        "independent": "scatter of all three",
        "wide": "scatter of all three, priors of τ 4 times as wide",
        "inferred": "scatter of all three, correlations inferred",
        "common": "scatter of all three, in common",
        "twice": "two scatters of all three, independent and in common",
        "alone": "scatter of the mass",
        "known": "scatter of the mass, τ = 16 % known",
        "updated": "an updated mass",
    }
    of = {name: found.get(("mass", allowance)) for name, allowance in words.items()}
    numbers = {name: MISSING if row is None else share(row.held) for name, row in of.items()}
    independent, alone = of["independent"], of["alone"]
    numbers["bias"] = MISSING if independent is None else f"{fixed(100.0 * independent.mean_error, 1)} %"
    numbers["sd"] = MISSING if independent is None else f"{fixed(100.0 * independent.sd, 1)} %"
    numbers["tau"] = MISSING if alone is None else f"{fixed(100.0 * alone.tau[0], 1)} %"
    return numbers


HEADER = (
    "error of the model", "the model allows for", "moduli covered", "mean posterior sd, %", "mean error of E1, %",
    "rms error, %", "median τ, %",
)  # fmt: skip
PAGE = """# A forgotten mass: scatter over the modes or an updated mass?

Why do 90 % intervals cover fewer moduli of beams if the model lacks a mass than if it has another error
([wrong-structures.md](wrong-structures.md)), and what corrects this? **Independent scatter over the modes cannot
represent a mass that lowers all frequencies: the intervals cover {independent} of the true moduli. Intervals with
an inferred correlation of the scatter cover {inferred}, with scatter in common {common}, and with an updated mass
{updated}.**

In each row, {structures} beams are simulated with frequencies that are linear in all values, and their two moduli
are updated. The joint, the thickness and the mass are allowed to scatter from mode to mode with a standard
deviation τ. τ is integrated out over points of its prior, without chains.

- The intervals are not too narrow, but biased: with independent scatter, the mean error of E1 is {bias}, and the
  mean posterior standard deviation is {sd}.
- The prior of τ is not the cause. With a prior four times as wide, the intervals cover {wide}.
- Independent scatter allows for a mass that is too large in one mode and too small in the next, and averages over
  the modes. A forgotten mass lowers all frequencies, and no average removes it. With scatter of the mass alone,
  the intervals cover {known} if τ is fixed at 16 %, four times the typical error; the median of the inferred τ is
  only {tau}.
- Scatter with an inferred correlation over the modes (`correlation = "inferred"`) and scatter in common to all
  modes (`correlation = 1.0`) can represent the error. So can an updated mass.
- Two scatters of each value, an independent one and one in common (`correlation = 1.0`), cover {twice}. Unlike a
  correlation, neither τ becomes undetermined if the scatter vanishes. For these rows, the table has √(τ₁² + τ₂²).

The rows without an error of the model show the price of each allowance: the larger posterior standard deviation.

{table}"""

if __name__ == "__main__":
    sys.exit(main())
