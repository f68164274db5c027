"""Compare `fmu.leave_one_out` on the built-in cases with reference evidences from separate runs of HMC.

    python -m tests.validation.left_out OUT [--kept DIRECTORY] [--minutes M]

Exit code 1 if an elpd differs from its reference by more than both 0.1 nat and four standard errors of the
reference, or if the p-values of measurements simulated by the model are not uniform.
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.special import expit, logit, logsumexp
from scipy.stats import kstest, multivariate_t
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.convergence.pareto import pareto_k
from fmu.analysis.evidence_estimators import by_bridge, by_importance
from fmu.analysis.trace.reading import parameter_draws
from fmu.numbers import significant
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.two_storeys import left_out as by_quadrature
from tests.validation.kept import Units, each, study_parser
from tests.validation.storeys import DESIGN_HZ, SD_HZ, problem, reduced_model

CASES = (
    ("shear-2dof", "index"),
    ("cantilever-young", "shape"),
    ("cantilever-young", "index"),
    ("cantilever-section", "shape"),
    ("cantilever-section", "index"),
    ("shear-10dof", "shape"),
    ("garteur", "shape"),
)
AS_PRINTED = ("garteur",)
"""Cases whose refits take far longer than the run. Their table is the one that the run stores, without refits."""
WITHIN = 0.1
"""Largest difference between an elpd and its reference, nats."""
CHAINS, DRAWS = 4, 2500
"""Chains that start at draws from the prior, as many chains at each maximum, and draws of each chain."""
HOPELESS, MOST_MAXIMA = 20.0, 4
"""Maxima further below the highest one than `HOPELESS`, in nats, are ignored; at most `MOST_MAXIMA` are used."""
GROUPS, FREEDOM = 12, 5
"""Number of Student's t distributions in the mixture, and their degrees of freedom."""
WEIGHED = 40_000
"""Draws from the mixture for importance sampling of the evidence."""
GOOD_K = 0.5
"""Importance weights with a larger Pareto k have an infinite variance (Vehtari et al. 2024)."""
REPLICATES = 300
LEVEL = 1e-3
"""Simulated buildings, and the p-value of the Kolmogorov–Smirnov test below which the study fails."""


@dataclass(frozen=True)
class Row:
    """One mode of a case: the row of `fmu.leave_one_out`, and the reference elpd with its standard error."""

    case: str
    mode: str
    method: str
    pareto_k: float
    elpd: float
    error: float
    p: float
    reference: float
    reference_error: float

    @property
    def is_off(self) -> bool:
        """Whether the elpd is off by more than both `WITHIN` and four standard errors of the reference."""
        return abs(self.elpd - self.reference) > max(WITHIN, 4.0 * self.reference_error)


class _Unbounded:
    """A problem in unbounded coordinates: the logit between two bounds, the logarithm above a lower bound."""

    def __init__(self, of: fmu.UpdatingProblem) -> None:
        self.of = of
        self.boxed = np.isfinite(of.lower) & np.isfinite(of.upper)
        self.above = np.isfinite(of.lower) & ~self.boxed
        self.width = np.where(self.boxed, of.upper - of.lower, of.scale)
        self.base = np.where(np.isfinite(of.lower), of.lower, of.offset)

    def coordinates(self, theta: FloatArray) -> FloatArray:
        """Return x (n, ndim) of theta."""
        u = (theta - self.base) / self.width
        with np.errstate(all="ignore"):
            return np.where(self.boxed, logit(u), np.where(self.above, np.log(np.maximum(u, 1e-300)), u))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log-density of x (n, ndim)."""
        with np.errstate(over="ignore"):
            u = np.where(self.boxed, expit(x), np.where(self.above, np.exp(np.minimum(x, 700.0)), x))
        inside = np.clip(self.base + self.width * u, self.of.lower, self.of.upper)
        slope = np.where(self.boxed, np.log(expit(x)) + np.log(expit(-x)), np.where(self.above, x, 0.0))
        return np.asarray(self.of.log_prob(inside)) + np.sum(slope + np.log(self.width), axis=1)


def log_evidence(of: fmu.UpdatingProblem, seed: int = 1) -> tuple[float, float]:
    """Return the log-evidence and its standard error, by importance or bridge sampling, from a run of HMC.

    Chains start at draws from the prior and at every maximum that is not negligible. They do not jump between
    maxima. A mixture of Student's t distributions is fitted to one half of the draws in unbounded coordinates. The
    mean of its importance weights is correct even if the chains visit the maxima in wrong proportions. If the tail
    of the weights is too heavy, optimal bridge sampling with the other half of the draws is used instead.
    """
    found = fmu.find_map(of)
    that_matter = [m.theta for m in found if m.log_prob > found[0].log_prob - HOPELESS][:MOST_MAXIMA]
    start = [*of.sample_prior(np.random.default_rng(seed), CHAINS), *np.repeat(that_matter, CHAINS, axis=0)]
    trace = fmu.sample(
        of, "hmc", chains=len(start), draws=DRAWS, warmup=500, seed=seed, init=np.array(start), jumps=False
    )
    space = _Unbounded(of)
    draws = space.coordinates(parameter_draws(trace))
    fitted, kept = (part.reshape(-1, of.ndim) for part in np.array_split(draws, 2, axis=1))
    rng = np.random.default_rng(seed)
    around = np.linalg.cholesky(np.cov(fitted.T).reshape(of.ndim, of.ndim))
    _, group = kmeans2(np.linalg.solve(around, fitted.T).T, GROUPS, minit="++", rng=rng)
    parts = [
        one for one in (fitted[group == g] for g in range(GROUPS)) if len(np.unique(one, axis=0)) > 4 * of.ndim
    ]
    share = np.array([len(part) for part in parts]) / sum(map(len, parts))
    students = [multivariate_t(part.mean(axis=0), np.cov(part.T), FREEDOM) for part in parts]
    counts = rng.multinomial(WEIGHED, share)
    other = np.concatenate(
        [t.rvs(n, random_state=rng).reshape(n, -1) for t, n in zip(students, counts, strict=True)]
    )

    def log_ratio(x: FloatArray) -> FloatArray:
        log_q = logsumexp([np.log(s) + t.logpdf(x) for s, t in zip(share, students, strict=True)], axis=0)
        return space.log_prob(x) - log_q

    l2 = log_ratio(other)
    if pareto_k(l2) < GOOD_K:
        return by_importance(l2)
    effective = min(len(kept), float(fmu.summary(trace)["ess_bulk"].min()) / 2)
    return by_bridge(l2, log_ratio(kept)[None], effective / len(kept))


def rows(case: str, pairing: str) -> list[Row]:
    """Return one row per measured mode of a case."""
    whole = fmu.cases.load(case, pairing)
    trace = fmu.sample(whole, "hmc", seed=1)
    table = fmu.leave_one_out(trace) if case in AS_PRINTED else fmu.leave_one_out(trace, whole)
    exact = by_quadrature() if case == "shear-2dof" else None
    of_whole = (0.0, 0.0) if exact is not None else log_evidence(whole)
    found = []
    for k, (label, row) in enumerate(table.iterrows()):
        if exact is not None:
            reference, error = float(exact[k]), 0.0
        elif np.isnan(row["elpd"]):
            reference, error = np.nan, np.nan
        else:
            log_z, error = log_evidence(whole.using([other for other in table.index if other != label]))
            reference, error = of_whole[0] - log_z, float(np.hypot(of_whole[1], error))
        of_row = (row["method"], row["pareto_k"], row["elpd"], row["mcse_elpd"], row["p"])
        found.append(Row(f"{case}, by {pairing}", str(label), *of_row, reference, error))
        print(found[-1], f"after {time.process_time():.0f} s", flush=True)
    return found


def probabilities() -> FloatArray:
    """Return p of both modes of a three-storey building for data simulated from its prior, (replicates, 2)."""
    rng, model, found = np.random.default_rng(1), reduced_model(), []
    of = problem(model, DESIGN_HZ)
    for theta in of.sample_prior(rng, REPLICATES):
        measured = of.frequencies(theta) + SD_HZ * rng.standard_normal(2)
        simulated = problem(model, measured)
        trace = fmu.sample(simulated, "hmc", chains=4, draws=250, warmup=250, seed=1)
        found.append(fmu.leave_one_out(trace, simulated)["p"].to_numpy())
    return np.array(found)


def main() -> int:
    """Run everything, write ``left-out.md``, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GARTEUR's reduced model just misses its tolerance
        kept = units.completed("cases", each(CASES), lambda of: [asdict(row) for row in rows(*of)])
        (p,) = units.completed("simulations", each([REPLICATES]), lambda _: probabilities(), np.array)
    found = [Row(**fields) for of_case in kept for fields in of_case]
    uniform = [float(kstest(column, "uniform").pvalue) for column in p.T]
    failures = [
        f"{row.case}, mode {row.mode}: elpd differs from the reference by {row.elpd - row.reference:+.3f} nat"
        for row in found
        if row.is_off
    ]
    failures += [
        f"simulated buildings, mode {k + 1}: p is not uniform (Kolmogorov–Smirnov: {significant(value, 2)})"
        for k, value in enumerate(uniform)
        if value < LEVEL
    ]
    write(found, uniform, failures, asked.out, units.processor_s)
    for failure in failures:
        print(failure)
    return 1 if failures else 0


def _with_error(row: Row) -> str:
    """Return the reference with its standard error, if it was computed and has one."""
    if np.isnan(row.reference):
        return ""
    return f"{row.reference:.3f}" + (f" ± {row.reference_error:.3f}" if row.reference_error else "")


def write(
    found: list[Row], uniform: list[float], failures: list[str], directory: Path, processor_s: float
) -> None:
    """Write ``left-out.md`` into the directory."""
    cells = [
        [row.case, row.mode, row.method or "none", f"{row.pareto_k:.2f}",
         f"{row.elpd:.3f} ± {row.error:.3f}" if np.isfinite(row.elpd) else "",
         _with_error(row),
         f"{row.elpd - row.reference:+.3f}" if np.isfinite(row.elpd) else "", significant(row.p, 2)]
        for row in found
    ]  # fmt: skip
    head = ["case, pairing", "mode", "method", "Pareto k", "elpd, nats", "reference, nats", "difference", "p"]
    known = [abs(row.elpd - row.reference) for row in found if np.isfinite(row.elpd)]
    verdict = "**Yes: every elpd agrees with its reference, and p is uniform for a correct model.**"
    if failures:
        verdict = "**Not in all cases:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    page = PAGE.format(
        verdict=verdict,
        within=WITHIN,
        good_k=GOOD_K,
        level=LEVEL,
        minutes=processor_s / 60.0,
        largest=max(known),
        printed=len(known),
        modes=len(found),
        replicates=REPLICATES,
        uniform=", ".join(significant(value, 2) for value in uniform),
        table=markdown_table(head, cells, words=(0, 2)),
    )
    (directory / "left-out.md").write_text(page)


PAGE = """# Leave-one-mode-out predictions

Does `fmu.leave_one_out` compute the log predictive density of each measured mode, given the other modes, and its
p-value correctly? {verdict}

The log predictive density is elpd = log p(y_k | y_-k) = log Z − log Z_-k, with the evidences Z with mode k and
Z_-k without it. `fmu.leave_one_out` gives an elpd for {printed} of {modes} modes of the built-in cases. The
largest difference from a reference is {largest:.3f} nat. A difference fails if it exceeds both {within:g} nat and
four standard errors of the reference. The study took {minutes:.0f} minutes of processor time.

- **Reference.** Each evidence comes from a separate run of HMC, whose chains start at draws from the prior and at
  the maxima of `find_map`. A mixture of Student's t distributions is fitted to half of the draws in unbounded
  coordinates. Importance sampling from this mixture gives the evidence. If the Pareto k of the weights is
  {good_k:g} or more, bridge sampling with the other half of the draws is used instead. For shear-2dof, the
  reference is Gauss–Legendre quadrature with a closed form of the frequencies; it uses no code of fmu.
- **Method.** With "refit", the posterior is updated without the mode. If a refit would take too long, a run
  reweights its draws (PSIS), provided that the Pareto k of the weights is below 0.5. With "none", neither method
  is reliable, and there is no elpd. For garteur, the table is the one that the run stores: refits would take far
  longer than the run.
- **p** is the two-sided tail probability of the measured frequency in its prediction. It is uniform if the model
  is correct, which need not be so in the built-in cases. To test p, {replicates} three-storey buildings were
  drawn from the prior, and their measurements were simulated. For their two modes, the Kolmogorov–Smirnov test of
  uniformity gives {uniform}; the study fails below {level:g}.

{table}"""


if __name__ == "__main__":
    sys.exit(main())
