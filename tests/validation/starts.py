"""Compare chains that start around the maxima of the posterior with chains that start from the prior.

    python -m tests.validation.starts OUT [--kept DIRECTORY] [--minutes M]

The exit code is 1 if a chain that started around the maxima is stuck at a maximum with less than 1 % of the
probability.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.certificate import CertificateWarning
from fmu.analysis.convergence.diagnostics import STANDING_LIMIT
from fmu.analysis.convergence.effective import by_walker, longest_stands
from fmu.analysis.maxima.missed import NEGLIGIBLE, draws_of_maxima
from fmu.analysis.maxima.results import Maxima, share_of_mass
from fmu.analysis.trace.reading import parameter_draws
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.four_storeys import SD, TRUTH, four_storeys
from tests.validation.kept import Units, each, fields_of, study_parser

WARMUP, DRAWS = 200, 100
SEEDS = {"hmc": 20, "mh": 5, "slice": 3, "emcee": 2}
SEEDS_FROM_PRIOR = {"hmc": 6, "mh": 5, "slice": 3, "emcee": 2}
BEAMS = tuple(
    (case, pairing) for case in ("cantilever-young", "cantilever-section") for pairing in ("shape", "index")
)


@dataclass(frozen=True)
class Run:
    """Positions of the chains of a run, or of the walkers of its ensembles.

    Attributes
    ----------
    paths : int
        Number of chains, or of walkers of all ensembles.
    stuck : int
        Number of chains or walkers with more than half of their draws at maxima with less than 1 % of the
        probability each.
    still : int
        Number of chains or walkers that do not move for a fifth of the draws in a row.
    visits : ndarray, shape (maxima,)
        Share of the draws at each maximum.
    """

    paths: int
    stuck: int
    still: int
    visits: FloatArray


@dataclass(frozen=True)
class Row:
    """All seeds of one problem, sampler and kind of start."""

    name: str
    sampler: str
    init: str
    shares: FloatArray
    runs: tuple[Run, ...]

    @property
    def failures(self) -> list[str]:
        """A sentence if chains that started around the maxima are stuck at negligible maxima."""
        stuck = sum(run.stuck for run in self.runs)
        if self.init != "maxima" or not stuck:
            return []
        of = f"{sum(run.paths for run in self.runs)} {self.kind}"
        maxima = f"maxima with less than {100 * NEGLIGIBLE:g} % of the probability"
        return [f"{self.name}, {self.sampler}: {stuck} of {of} are stuck at {maxima}"]

    @property
    def kind(self) -> str:
        """The word for the paths: chains, or walkers of ensembles."""
        return "walkers" if self.sampler == "emcee" else "chains"


def sampled(problem: Any, maxima: Maxima, sampler: str, init: str, seed: int) -> Run:
    """Make a run with default settings and return the positions of its chains."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CertificateWarning)  # irrelevant on the way from the prior
        trace = fmu.sample(
            problem, sampler, draws=DRAWS, warmup=WARMUP, seed=seed, init=init, maxima=maxima, progress=False
        )
    position, walkers = parameter_draws(trace), int(trace.attrs["walkers"])
    lp = trace["sample_stats"]["lp"].transpose("chain", "draw").to_numpy()
    at = draws_of_maxima(position.reshape(-1, problem.ndim), lp.ravel(), maxima).reshape(lp.shape)
    little = np.array([m.share < NEGLIGIBLE for m in maxima] + [False])  # the last: draws near no maximum
    stuck = np.mean(by_walker(little[at], walkers), axis=2) > 0.5
    still = longest_stands(position, walkers) >= STANDING_LIMIT * DRAWS
    visits = np.array([np.mean(at == k) for k in range(len(maxima))])
    return Run(stuck.size, int(stuck.sum()), int(still.sum()), visits)


PROBLEMS: dict[str, Callable[[], Any]] = {"frame of four storeys": four_storeys} | {
    f"{case}, by {'number' if pairing == 'index' else pairing}": partial(fmu.cases.load, case, pairing)
    for case, pairing in BEAMS
}


@cache
def problem_of(name: str) -> tuple[Any, Maxima]:
    """Return a problem and its maxima."""
    problem = PROBLEMS[name]()
    return problem, fmu.find_map(problem)


def study(units: Units) -> Iterator[Row]:
    """Yield the rows of all problems, samplers and kinds of start."""
    kinds = [
        (name, sampler, init, seeds[sampler])
        for name in PROBLEMS
        for sampler in SEEDS
        for init, seeds in (("maxima", SEEDS), ("prior", SEEDS_FROM_PRIOR))
    ]

    def run(key: tuple[str, str, str, int]) -> dict[str, Any]:
        name, sampler, init, seed = key
        return {"kind": key[:3], "run": asdict(sampled(*problem_of(name), sampler, init, seed))}

    keys = [(*kind, seed) for *kind, seeds in kinds for seed in range(1, seeds + 1)]
    found = units.completed("runs", each(keys), run)
    for name, sampler, init, _ in kinds:
        runs = [fields_of(Run, np.array)(one["run"]) for one in found if one["kind"] == [name, sampler, init]]
        if runs:
            shares = np.array([m.share for m in problem_of(name)[1]])
            yield Row(name, sampler, init, shares, tuple(runs))


def write(rows: list[Row], directory: Path, processor_s: float) -> None:
    """Write ``starts.md`` into the directory."""
    failures = [failure for row in rows for failure in row.failures]
    verdict = "**No chain that started around the maxima is stuck at one with less than 1 % of the probability.**"
    if failures:
        verdict = "**Stuck chains that started around the maxima:**\n\n"
        verdict += "\n".join(f"- {failure}" for failure in failures)
    shares = {row.name: row.shares for row in rows}
    maxima = markdown_table(
        ["problem", "maxima", "shares of the probability"],
        [[name, str(len(s)), ", ".join(share_of_mass(x) for x in s)] for name, s in shares.items()],
    )
    (directory / "starts.md").write_text(
        PAGE.format(
            minutes=processor_s / 60.0,
            verdict=verdict,
            warmup=WARMUP,
            draws=DRAWS,
            truth=", ".join(f"{x:g}" for x in TRUTH),
            sd=100 * SD,
            still=100 * STANDING_LIMIT,
            maxima=maxima.rstrip(),
            runs=markdown_table(HEAD, [_cells(row) for row in rows], words=(0, 1, 2)).rstrip(),
        ),
        encoding="utf-8",
    )


def mismatch(visits: FloatArray, shares: FloatArray) -> float:
    """Return the share of the draws that are at the wrong place, or near no maximum.

    This is the total variation distance between the shares of the draws and of the probability, both of sum 1
    with the share near no maximum.
    """
    nowhere = shares.sum() - visits.sum()
    return float(0.5 * (np.sum(np.abs(visits - shares)) + abs(nowhere)))


def _cells(row: Row) -> list[str]:
    paths = sum(run.paths for run in row.runs)
    stuck, still = (sum(getattr(run, what) for run in row.runs) for what in ("stuck", "still"))
    spoilt = sum(run.stuck > 0 for run in row.runs)
    away = np.mean([mismatch(run.visits, row.shares) for run in row.runs])
    return [
        row.name, row.sampler, row.init, str(len(row.runs)), f"{stuck} of {paths} {row.kind}", str(still),
        str(spoilt), f"{100 * away:.0f} %",
    ]  # fmt: skip


HEAD = [
    "problem", "sampler", "start", "runs", "stuck", "not moving", "affected runs", "mismatch of shares",
]  # fmt: skip

PAGE = """# Where chains start

Do chains get stuck at maxima of the posterior that have a negligible probability?

{verdict}

A chain rarely leaves the basin of a maximum. By default (`init="maxima"`), `fmu.sample` and `fmu run` search for
the maxima of the posterior and start the chains around them, in proportion to their shares of the probability. A
maximum with less than 1 % gets no chain. Chains that start from the prior (`init="prior"`) may fall into the basin
of such a maximum and stay there. This study compares the two kinds of start. It took {minutes:.0f} minutes of
processor time.

Every run has four chains (emcee: four ensembles of 32 walkers), the default settings of its sampler, {warmup}
steps of warm-up and {draws} draws. This is shorter than the default, so chains have less time to leave a
maximum. The columns are:

- *stuck*: chains or walkers with more than half of their draws at maxima with less than 1 % of the probability
  each; *affected runs*: runs with at least one of them;
- *not moving*: chains or walkers with the same position in at least {still:.0f} % of the draws, one after another.
  After so short a warm-up this does not indicate a wrong position;
- *mismatch of shares*: the share of the draws that would have to move to another maximum, or to one at all, for
  the draws to be divided as the probability is (total variation distance); mean over the runs.

The frame has four storeys with stiffnesses of {truth} times 200 MN/m and floors of 100 t each. Its four
frequencies, with errors of {sd:g} %, do not determine the stiffnesses uniquely: four frames have the same
frequencies. The other problems are models of the paper's beam.

{maxima}

{runs}

- **The shares are only as good as the search.** A maximum that the search misses gets no chain. If a run finds
  such a place all the same, `fmu.diagnose` reports it.
- **Starts at known maxima make R-hat less sensitive**, because chains that start alike agree sooner. The starting
  points therefore scatter twice as widely as the posterior around a maximum. If chains never move between maxima,
  R-hat is large and the run is not reported as converged, even if the numbers of chains match the shares.
- **Few chains give coarse shares.** While no chain moves between maxima, each of four chains holds 25 % of the
  draws, whatever the share of its maximum. mh, slice and hmc propose jumps between several maxima by default,
  which reduces the mismatch, but the shares of so few draws scatter. More chains also reduce it, and so does
  parallel tempering.
"""


def main() -> int:
    """Run the study, write ``starts.md``, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1):
        rows = list(study(units))
    write(rows, asked.out, units.processor_s)
    failures = [failure for row in rows for failure in row.failures]
    for failure in failures:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
