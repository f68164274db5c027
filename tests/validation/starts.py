"""Where chains end that start at the maxima of the posterior, and where those that start from the prior do.

    python -m tests.validation.starts OUT [--kept DIRECTORY] [--minutes M]

Exit code 1 where a chain that started at the maxima is stuck at one that holds less than 1 %.
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
    """Where the chains (walkers of ensembles) of a run ended.

    Attributes
    ----------
    paths : int
        Chains, or walkers of all ensembles.
    stuck : int
        Of them, those with more than half of their draws at maxima that hold less than 1 % each.
    still : int
        Of them, those that stand still for a fifth of the draws.
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
        """Say so if a chain that started at the maxima is stuck at one that holds next to nothing."""
        stuck = sum(run.stuck for run in self.runs)
        if self.init != "maxima" or not stuck:
            return []
        return [f"{self.name}, {self.sampler}: {stuck} chains are stuck at maxima of less than {NEGLIGIBLE:.0%}"]


def sampled(problem: Any, maxima: Maxima, sampler: str, init: str, seed: int) -> Run:
    """Return where the chains of a run with default settings ended."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CertificateWarning)  # on the way from the prior it means nothing
        trace = fmu.sample(
            problem, sampler, draws=DRAWS, warmup=WARMUP, seed=seed, init=init, maxima=maxima, progress=False
        )
    position, walkers = parameter_draws(trace), int(trace.attrs["walkers"])
    lp = trace["sample_stats"]["lp"].transpose("chain", "draw").to_numpy()
    at = draws_of_maxima(position.reshape(-1, problem.ndim), lp.ravel(), maxima).reshape(lp.shape)
    little = np.array([m.share < NEGLIGIBLE for m in maxima] + [False])  # the last for draws near none
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
    """Yield all rows."""
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
    verdict = "**No chain that started at the maxima is stuck at one of less than 1 %.**"
    if failures:
        verdict = "**Chains that are stuck:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    shares = {row.name: row.shares for row in rows}
    maxima = markdown_table(
        ["", "maxima", "their shares of the probability"],
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
            runs=markdown_table(HEAD, [_cells(row) for row in rows]).rstrip(),
        ),
        encoding="utf-8",
    )


def _cells(row: Row) -> list[str]:
    paths = sum(run.paths for run in row.runs)
    kind = "walkers" if row.sampler == "emcee" else "chains"
    stuck, still = (sum(getattr(run, what) for run in row.runs) for what in ("stuck", "still"))
    spoilt = sum(run.stuck > 0 for run in row.runs)
    away = np.mean([0.5 * np.sum(np.abs(run.visits - row.shares)) for run in row.runs])
    return [
        row.name, row.sampler, row.init, str(len(row.runs)), f"{stuck} of {paths} {kind}", str(still), str(spoilt),
        f"{100 * away:.0f} %",
    ]  # fmt: skip


HEAD = [
    "", "sampler", "start", "runs", "stuck at a maximum below 1 %", "standing still", "runs with a stuck one",
    "draws at a wrong maximum",
]  # fmt: skip

PAGE = """# Where chains start

Written by `make validate` in {minutes:.0f} minutes of processor time.

{verdict}

A chain seldom leaves the maximum whose basin it fell into. `fmu.sample` and `fmu run` search for the maxima of the
posterior before they sample, and start the chains around them, in proportion to their shares of the probability
(`init="maxima"`, the default); a maximum that holds less than 1 % gets none. Chains that start from the prior
(`init="prior"`) fall into whatever basin is near, and some stay where next to nothing is.

Every run has four chains (of emcee four ensembles of 32 walkers) with the default settings of its sampler,
{warmup} steps of warm-up and {draws} draws: less than the default, so that chains have less time to get away.
A chain or walker is *stuck* with more than half of its draws at maxima that hold less than 1 % each, and *stands
still* where {still:.0f} % of its draws in a row are one and the same. The last column is the share of draws that
would have to move to another maximum, or to one at all, for the draws to be divided as the probability is, by the
search: the average over the runs.

Standing still is no sign of a wrong place. After so short a warm-up a random walk or a walker may well repeat its
position twenty times.

The frame has storeys of {truth} times 200 MN/m under equal floors of 100 t. Its four frequencies, with
errors of {sd:g} %, do not determine the four stiffnesses: four frames have them. The other problems are those of
the paper.

{maxima}

{runs}

- **Shares are only as good as the search.** What it did not find gets no chain; of the draws of a run that found
  its way to such a place `fmu.diagnose` says so.
- **Starting in known modes takes power from R-hat**: chains that start alike agree sooner. Hence they start twice
  as wide as the posterior is around a maximum; and where no chain ever changes maxima, R-hat over chains in
  different ones is large, and the verdict is not good, however well their numbers match the shares.
- **Few chains hold coarse shares.** While no chain changes maxima, each of four holds 25 % of the draws, which is
  10 % away from the shares of the frame. Chains of HMC do change maxima there now and then, and so few draws of
  them scatter. More chains come nearer, and so does parallel tempering.
"""


def main() -> int:
    """Run everything, write ``starts.md``, and return the exit code."""
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
