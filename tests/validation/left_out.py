"""Each measured mode of the built-in cases predicted by the others, against evidences from runs of HMC.

    python -m tests.validation.left_out OUT [--kept DIRECTORY] [--minutes M]...]

Exit code 1 where a number of `fmu.leave_one_out` is off by more than 0.1 nat, or the probabilities of measurements
of a model that is right are not uniform.
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
"""Cases whose refits take far longer than a run: for them the table that the run itself prints is looked at."""
WITHIN = 0.1
"""Nats."""
CHAINS, DRAWS = 4, 2500
"""Chains from the prior, and from each maximum."""
HOPELESS, MOST_MAXIMA = 20.0, 4
"""A maximum that lies further below the highest one does not matter, in nats."""
GROUPS, FREEDOM = 12, 5
WEIGHED = 40_000
"""Draws of the mixture of `GROUPS` Student distributions that evidences are weighed with."""
GOOD_K = 0.5
"""Importance weights with a larger Pareto k have no variance (Vehtari et al. 2024)."""
REPLICATES = 300
LEVEL = 1e-3


@dataclass(frozen=True)
class Row:
    """One mode of a case: what `fmu.leave_one_out` says, and the reference with its standard error."""

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
        """Whether the two differ by more than `WITHIN`, and four standard errors of the reference."""
        return abs(self.elpd - self.reference) > max(WITHIN, 4.0 * self.reference_error)


class _Unbounded:
    """A problem in coordinates without bounds: logit between two bounds, log above one."""

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
    """Return log-evidence and standard error, by importance sampling or bridge sampling from a run of HMC.

    Chains start at draws from the prior and at every maximum that may matter, and do not jump. A mixture of
    Student distributions is fitted to one half of their draws, in coordinates without bounds. The mean of its
    importance weights needs no right proportion between maxima, of which chains that never cross know nothing.
    Where the weights have too heavy a tail, the mixture is bridged to the other half of the draws with the optimal
    bridge.
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
    """Return the modes of a case."""
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
    """Return p of both modes of a building of three storeys for data simulated by its prior, (replicates, 2)."""
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
    failures = [f"{row.case}, mode {row.mode}: {row.elpd} for {row.reference}" for row in found if row.is_off]
    failures += [f"p of mode {k + 1} is not uniform: {value}" for k, value in enumerate(uniform) if value < LEVEL]
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
    head = ["case", "mode", "how", "Pareto k", "elpd, nats", "reference", "difference", "p"]
    known = [abs(row.elpd - row.reference) for row in found if np.isfinite(row.elpd)]
    page = PAGE.format(
        verdict="**All within 0.1 nat.**" if not failures else "**Off:** " + "; ".join(failures),
        minutes=processor_s / 60.0,
        largest=max(known),
        printed=len(known),
        modes=len(found),
        replicates=REPLICATES,
        uniform=", ".join(significant(value, 2) for value in uniform),
        table=markdown_table(head, cells, words=(0, 2)),
    )
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "left-out.md").write_text(page)


PAGE = """# Modes left out

Written by `python -m tests.validation.left_out results` in {minutes:.0f} minutes of processor time. {verdict}

`fmu.leave_one_out` compares each measured mode with its prediction from the other modes. elpd is the log-density
of what was measured of the mode given the others, log p(y_k | y_-k) = log Z − log Z_-k. The reference is the
difference of two evidences, from a run of HMC with the mode and one without it, whose chains start at draws from
the prior and at the maxima of `find_map`: a mixture of Student distributions is fitted to half of its draws in
coordinates without bounds, and gives the evidence by the mean of its importance weights or, where their Pareto k
is above 0.5, by a bridge to the other half of the draws. For shear-2dof it is Gauss–Legendre quadrature with a
formula for the frequencies, without anything of fmu. {printed} of {modes} modes have a number; the largest
difference is {largest:.3f} nat. Of garteur the table is the one that a run prints: refits would take far longer
than the run, and modes that need one have no number.

{table}
"refit" is updating without the mode; where its weights are not reliable, there is no elpd. Where a refit takes too
long, a run relies on smoothed importance weights (PSIS) of its draws, and only if their Pareto k is below 0.5.

p is the probability of a measurement at least as far out on either side. For {replicates} buildings of three
storeys drawn from the prior, with measurements simulated by the model, it must be uniform: the Kolmogorov–Smirnov
test gives {uniform} for the two modes.
"""


if __name__ == "__main__":
    sys.exit(main())
