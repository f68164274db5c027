"""Pose updating problems on forty random models, and compare their frequencies with extended precision.

    python -m tests.validation.random_models OUT [--kept DIRECTORY] [--minutes M]

Writes ``random-models.md``. Exit code 1 if a model needs more than its budget of counted work, if a frequency is
wrong, if a library warns, or if fmu refuses more than one model or one without a loss of digits.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

import fmu
from fmu.fem.reduced.reduced_structure import largest_tolerance_elsewhere
from fmu.fem.reduced.training import BUDGET
from fmu.numbers import MISSING, share, significant, whole
from fmu.posterior.reduction.train_reduced import ReductionWarning
from fmu.posterior.rounding import WARN, RoundingWarning
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.models.extended_precision import rounded
from tests.models.random_models import RandomModel, random_model
from tests.validation.kept import Units, each, study_parser
from tests.work import Work, counted

MODES, POINTS, SD = 3, 2, 5e-3
"""Number of measured modes, number of points of comparison, and relative standard deviation of a frequency."""
SEEDS, MOST_DOFS, MOST_REFUSED = range(40), 5000, 1
MOST = Work(4 * BUDGET, BUDGET, 60 * BUDGET)
"""Budget of work. An eigenproblem of a full model takes about 40 solves and 4 factorisations."""
ALLOWED = 10.0
"""Largest error of the full model, in units of the rounding error expected from the cancellation in φᵀKφ."""
TRUSTED, BEYOND = 1e-6, 2.0
"""Allowed error of a reduced model. If fmu warns that it misses this, `BEYOND` times the error in the warning."""
_SOLVER, _DRAWS = 4.0, 4  # times that a solver rounds, as in fmu.posterior.rounding; random roundings of K


@dataclass
class Found:
    """Result of one model. Errors are relative errors of frequencies.

    Attributes
    ----------
    work : Work
    basis : int or None
        Size of the reduced model; None if the full model is used.
    error, reduced : float
        Largest error of the full model, and of the model that is used.
    roundings : float
        Largest error of the full model, in units of the rounding error expected from cancellation.
    said : tuple of str
        Texts of fmu's warnings.
    refused : str or None
        Text of a refusal.
    faults : list of str
    """

    seed: int
    random: RandomModel
    work: Work = field(default_factory=Work)
    basis: int | None = None
    error: float = 0.0
    reduced: float = 0.0
    roundings: float = 0.0
    said: tuple[str, ...] = ()
    refused: str | None = None
    faults: list[str] = field(default_factory=list)


def examined(seed: int, most_dofs: int = MOST_DOFS) -> Found:
    """Pose a problem on the model of a seed, and compare its frequencies with extended precision."""
    random = random_model(seed, most_dofs)
    found, start = Found(seed, random), np.ones(len(random.parameters))
    try:
        measured = in_hz(random.modes(1.03 * start, MODES)[0])
    except np.linalg.LinAlgError:  # rounding in K has swamped a soft part
        measured = in_hz(np.arange(1.0, MODES + 1.0))
    data = fmu.ModalData(measured, sd_hz=SD * measured)
    theta = np.random.default_rng(seed).uniform(0.7, 1.3, size=(POINTS, len(start)))
    with warnings.catch_warnings(record=True) as caught, counted() as found.work:
        warnings.simplefilter("always")
        try:
            problem = fmu.UpdatingProblem.reduced(random.model, data, random.parameters, pairing="index")
        except ValueError as error:
            found.refused = str(error)
            found.faults += refused_wrongly(random, start, found.refused)
            return found
        full, answered = problem.model.truth.frequencies(theta), problem.frequencies(theta)
        if not np.isfinite(problem.log_prob_and_grad(theta)[0]).all():
            found.faults.append("the log-probability is not finite")
    found.said = tuple(str(w.message) for w in caught if w.category in (RoundingWarning, ReductionWarning))
    found.faults += [f"{w.category.__name__}: {w.message}" for w in caught if str(w.message) not in found.said]
    for name in ("factorisations", "eigenproblems", "solves"):
        if getattr(found.work, name) > getattr(MOST, name):
            found.faults.append(f"{getattr(found.work, name)} {name}, at most {getattr(MOST, name)} allowed")
    found.basis = sum(problem.model.sizes) or None
    _compare(found, problem.model, theta, full, answered)
    if found.error > WARN * SD and not any(said.startswith("rounding: ") for said in found.said):
        sd = f"{found.error / SD:.2g} standard deviations"
        found.faults.append(f"no rounding warning, although a frequency is off by {found.error:.1e} ({sd})")
    return found


def _compare(found: Found, model: object, theta: FloatArray, full: FloatArray, answered: FloatArray) -> None:
    """Compare frequencies (n, MODES) of the full model and of the model used with extended precision."""
    told = re.search(r"frequencies are off by up to ([^ ;]+)", " ".join(found.said))
    allowed = BEYOND * float(told[1]) if told else largest_tolerance_elsewhere(model) or TRUSTED
    for point, of_full, of_answer in zip(theta, full, answered, strict=True):
        frequencies, rounding = exact(found.random, point)
        error, reduced = np.abs(of_full / frequencies - 1.0), np.abs(of_answer / frequencies - 1.0)
        found.error, found.reduced = max(found.error, error.max()), max(found.reduced, reduced.max())
        found.roundings = max(found.roundings, np.max(error / rounding))
        if not np.all(error <= ALLOWED * rounding):
            found.faults.append(f"full model: {_off(error, ALLOWED * rounding)}")
        if not np.all(reduced <= ALLOWED * rounding + allowed):
            found.faults.append(f"reduced model: {_off(reduced, ALLOWED * rounding + allowed)}")


def _off(error: FloatArray, allowed: FloatArray) -> str:
    """Return the relative error that exceeds its limit most, in words."""
    worst = int(np.argmax(error / allowed))
    return f"frequency {worst + 1} has a relative error of {error[worst]:.1e} ({allowed[worst]:.1e} allowed)"


def exact(random: RandomModel, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest elastic frequencies in Hz, (MODES,), and their relative rounding error from cancellation.

    The rounding error of a frequency is half that of an eigenvalue: u |φ|ᵀ|K||φ|/λ, and √n u for the sums.
    """
    lam, phi = random.modes(theta, MODES)
    K = sum(abs(c) * abs(term.matrix) for c, term in zip(theta, random.model.K_terms, strict=True))
    sizes = np.sum(np.abs(phi) * (K[: len(phi), : len(phi)] @ np.abs(phi)), axis=0) / lam
    return in_hz(lam), 0.5 * np.finfo(float).eps * (sizes.astype(float) + len(phi) ** 0.5)


def refused_wrongly(random: RandomModel, start: FloatArray, sentence: str) -> list[str]:
    """Return the faults of a refusal: digits must be lost, and the message must say so.

    Digits are lost if rounding the entries of K, as often as a solver does, changes a frequency by more than its
    standard deviation.
    """
    if not sentence.startswith("rounding: "):
        return [f"refused: {sentence}"]
    rng, moved = np.random.default_rng(0), [0.0]
    try:
        exactly = in_hz(random.modes(start, MODES)[0])
        for _ in range(_DRAWS):
            changed = in_hz(random.modes(start, MODES, lambda K: rounded(K, rng))[0])
            moved.append(np.max(np.abs(changed / exactly - 1.0)))
    except np.linalg.LinAlgError:  # K is no longer positive definite
        return []
    if _SOLVER * max(moved) > SD:
        return []
    return [f"refused, although rounding changes the frequencies by only {max(moved):.1e}"]


def in_hz(lam: FloatArray) -> FloatArray:
    """Return frequencies in Hz."""
    return np.sqrt(lam.astype(float)) / (2.0 * np.pi)


def page(found: list[Found]) -> str:
    """Return the page in Markdown."""
    header = (
        "seed", "model", "factorisations", "eigenproblems", "solves", "basis", "error of the full model",
        "error / expected rounding", "error of the model used", "warnings of fmu",
    )  # fmt: skip
    lines = []
    for of in found:
        counts = map(whole, (of.work.factorisations, of.work.eigenproblems, of.work.solves))
        basis = MISSING if of.basis is None else whole(of.basis)
        errors = (significant(of.error, 2), significant(of.roundings, 2), significant(of.reduced, 2))
        said = [text.partition(":")[0] for text in of.said] + (["refused"] if of.refused else [])
        errors = (MISSING,) * 3 if of.refused else errors
        lines.append((str(of.seed), str(of.random), *counts, basis, *errors, ", ".join(said) or MISSING))
    faults = [f"- seed {of.seed}, {of.random}: {fault}" for of in found for fault in of.faults]
    refused = [f"- seed {of.seed}, {of.random}: {of.refused}" for of in found if of.refused]
    count = f"{len(faults) or 'No'} fault{'' if len(faults) == 1 else 's'}"
    verdict = f"**{count}; {len(refused)} of {len(found)} models refused.**"
    return PAGE.format(
        models=len(found),
        verdict="\n".join([verdict, "", *faults, *refused] if faults or refused else [verdict]),
        modes=MODES,
        sd=significant(100 * SD),
        points=POINTS,
        allowed=ALLOWED,
        trusted=significant(TRUSTED, 1),
        beyond=BEYOND,
        warn=share(WARN),
        factorisations=whole(MOST.factorisations),
        eigenproblems=whole(MOST.eigenproblems),
        solves=whole(MOST.solves),
        table=markdown_table(header, lines, words=(1, 9)),
    )


def kept_of(found: Found) -> dict[str, Any]:
    """Return the result of a model for storage, without the model, which follows from its seed."""
    return {f.name: getattr(found, f.name) for f in fields(found) if f.name != "random"} | {
        "work": asdict(found.work)
    }


def of_kept(kept: dict[str, Any]) -> Found:
    """Return the result of a model from its stored form."""
    random = random_model(kept["seed"], MOST_DOFS)
    return Found(**kept | {"random": random, "work": Work(**kept["work"]), "said": tuple(kept["said"])})


def main() -> int:
    """Examine all models and write the page."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    found = units.completed("models", each(SEEDS), lambda seed: kept_of(examined(seed)), of_kept)
    (asked.out / "random-models.md").write_text(page(found), encoding="utf-8")
    return 1 if any(of.faults for of in found) or sum(of.refused is not None for of in found) > MOST_REFUSED else 0


PAGE = """# Random models

Does fmu pose and solve updating problems on {models} random models within a budget of work, with accurate
frequencies, and does it warn if rounding errors matter? {verdict}

Each model is made from a seed: beams, springs and masses with 50 to 5000 degrees of freedom, and 1 to 20 terms of
stiffness over 0.1 to 8 decades (`tests/models/random_models.py`). {modes} modes are measured with a standard
deviation of {sd} %. Some models have no supports (free), modes in pairs (double), a part that can move without
strain (mechanism), or a body on a nearly singular spring (weak).

Frequencies are compared at {points} points with subspace iterations in extended precision
(`tests/models/extended_precision.py`). Errors are relative. A fault is

- an error of the full model above {allowed:g} times the rounding error expected from the cancellation in φᵀKφ,
- an error of the reduced model above this limit plus {trusted} (if fmu states a coarser tolerance for a part of
  the box, plus that tolerance; if fmu warns of a larger error, plus {beyond:g} times that error),
- a rounding error of more than {warn} of the standard deviation without a warning,
- more work than {factorisations} factorisations, {eigenproblems} eigenproblems of the full model or {solves}
  solves,
- a warning from a library, or
- a refusal, unless rounding the entries of K, as often as a solver does, changes a frequency by its standard
  deviation.

The table has the largest errors. Without a basis, the full model is used.

{table}"""


if __name__ == "__main__":
    os.environ["FMU_CACHE_DIR"] = ""  # no reduced models of earlier runs
    sys.exit(main())
