"""All studies whose pages are in results/: this table alone says what there is.

`make results` runs those whose pages are missing or older than the code, and `make results-list` prints the table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

VALIDATION, BENCHMARKS, PAPER, COMPARISON, FAULTS = "validate", "bench", "paper", "compare", "mutants"
TOTAL_MINUTES, CORES = 8 * 60, 2
MOST_MINUTES = 45


@dataclass(frozen=True)
class Study:
    """A study.

    Attributes
    ----------
    name : str
    minutes : float
        Its budget: the time of its units of work, after which it begins no further one.
    module : str
        Run as ``python -m MODULE``, with the arguments.
    pages : tuple of str
        The pages that it writes, in results/.
    folders : tuple of str
        The folders of pictures and data that it writes, in results/.
    group : str
        `make GROUP` runs the studies of a group.
    exclusive : bool
        Whether it needs the machine alone: it measures times by the clock, or uses all cores.
    also : tuple of str
        Modules that it runs without importing them.
    arguments : tuple of str
        Where the pages are written, where units are kept, and the budget.
    """

    name: str
    minutes: float
    module: str
    pages: tuple[str, ...]
    folders: tuple[str, ...] = ()
    group: str = VALIDATION
    exclusive: bool = False
    also: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ("{out}", "--kept", "{kept}", "--minutes", "{minutes}")

    @property
    def command(self) -> str:
        """The command that writes its pages."""
        before = self.arguments[: self.arguments.index("{out}")]
        return " ".join(("python -m", self.module, *before, "results"))

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules that it starts from."""
        return (self.module, *self.also)


def _study(name: str, minutes: float, *folders: str, exclusive: bool = False, also: tuple[str, ...] = ()) -> Study:
    module = f"tests.validation.{name.replace('-', '_')}"
    return Study(name, minutes, module, (f"{name}.md",), folders, exclusive=exclusive, also=also)


_EXPERIMENTS = tuple(f"{what}-{pairing}" for what in ("young", "section") for pairing in ("shape", "index"))
_OF_PAPER = (
    "README", "errata", "recomputed", "vector-beta", "model-error", *(f"{one}/tables" for one in _EXPERIMENTS),
)  # fmt: skip

_POSTERIORS = {
    "cantilever-young-shape": 16, "cantilever-young-index": 10, "cantilever-section-shape": 10,
    "cantilever-section-index": 16, "cantilever-frf-shape": 16, "shear-10dof-index": 20, "garteur-shape": 36,
    "frame-50-index": 36,
}  # fmt: skip
"""Minutes of the peers on each posterior."""

STUDIES = (
    Study("paper", 10, "fmu", tuple(f"{page}.md" for page in _OF_PAPER),
          (*_EXPERIMENTS, "recomputed.csv", "vector-beta.csv", "vector-beta.png", "model-error.csv",
           "model-error.png", "manifest.json", "traces"), PAPER,
          exclusive=True, also=("fmu.cli",), arguments=("paper", "--out", "{out}")),
    Study("benchmarks", 7, "tests.benchmarks", ("benchmarks.md",), ("benchmarks",), BENCHMARKS,
          exclusive=True, also=("tests.benchmarks.test_log_prob", "tests.benchmarks.test_tower")),
    Study("mutants", 35, "tests.validation.mutants", ("mutants.md",), (), FAULTS, exclusive=True,
          also=("fmu.cli",)),
    _study("scale", 25, "scale", exclusive=True, also=("tests.validation.scale_row",)),
    _study("large-structures", 40, exclusive=True, also=("tests.validation.large_run", "fmu.cli")),
    _study("kernels", 18, exclusive=True, also=("fmu.cli",)),
    _study("workers", 8, exclusive=True),
    *(Study(f"peers-{one}", minutes, "tests.benchmarks.peers", (f"peers/{one}.md",), (f"peers/{one}.png",),
            BENCHMARKS, arguments=("--posterior", one, "{out}", "--kept", "{kept}", "--minutes", "{minutes}"))
      for one, minutes in _POSTERIORS.items()),
    _study("verdicts", 32),
    _study("coverage", 26, "coverage"),
    _study("left-out", 24),
    _study("populations", 45),
    _study("campaigns", 32),
    _study("wrong-structures", 30),
    _study("densities", 25),
    _study("wrong-model", 25),
    _study("surrogate", 20),
    _study("frfs", 20),
    _study("several-tests", 16),
    _study("seeds", 22),
    Study("validation", 20, "tests.validation", ("validation.md",), ("validation",)),
    _study("planning", 20),
    _study("hostile", 15),
    _study("garteur", 20, "garteur"),
    _study("fit", 14, "fit"),
    _study("emcee-moves", 10),
    _study("random-models", 15),
    _study("damage-intervals", 10),
    _study("starts", 10),
    _study("kills", 10, also=("tests.validation.kills_run",)),
    _study("hyper-parameters", 10),
    _study("replicates", 10),
    _study("bound", 10),
    Study("compare", 8, "tests.results.compare", ("compare/README.md",), ("compare",), COMPARISON,
          also=("fmu.cli",)),
    _study("contradictions", 6),
    _study("evidence", 5),
    _study("forgotten-mass", 2),
)  # fmt: skip
"""In the order in which `make results` begins them: those that need the machine alone, and then the longest."""


def chosen(names: tuple[str, ...], times: float = 1.0) -> list[Study]:
    """Return the studies of these names or groups, in their order; all without names.

    Their budgets are multiplied by `times`, so that a slow machine does as many units of work as another.

    Raises
    ------
    ValueError
        If there is no such study or group.
    """
    known = {study.name for study in STUDIES} | {study.group for study in STUDIES}
    for name in names:
        if name not in known:
            raise ValueError(f"there is no study or group {name!r}: use one of {', '.join(sorted(known))}")
    wanted = [study for study in STUDIES if not names or {study.name, study.group} & set(names)]
    return [replace(study, minutes=times * study.minutes) for study in wanted]


def wall_minutes() -> float:
    """Return the budget of all studies together, by the clock."""
    alone = sum(study.minutes for study in STUDIES if study.exclusive)
    return alone + sum(study.minutes for study in STUDIES if not study.exclusive) / CORES
