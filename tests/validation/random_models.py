"""Forty random models, posed and solved.

    python -m tests.validation.random_models OUT [--kept DIRECTORY] [--minutes M]

Writes ``random-models.md``. Exit code 1 if a model costs more than its budget of counted work, if a frequency is
wrong, if a library warns, or if a model is refused whose digits are not lost.
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
from fmu.numbers import MISSING, significant, whole
from fmu.posterior.reduction.train_reduced import ReductionWarning
from fmu.posterior.rounding import WARN, RoundingWarning
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.models.extended_precision import rounded
from tests.models.random_models import RandomModel, random_model
from tests.validation.kept import Units, each, study_parser
from tests.work import Work, counted

MODES, POINTS, SD = 3, 2, 5e-3
"""Modes measured, points at which frequencies are compared, standard deviation relative to a frequency."""
SEEDS, MOST_DOFS, MOST_REFUSED = range(40), 5000, 1
MOST = Work(4 * BUDGET, BUDGET, 60 * BUDGET)
"""An eigenproblem of a full model takes about 40 solves and 4 factorisations."""
ALLOWED = 10.0
"""Roundings that an error may be, of those that the cancellation in φᵀKφ allows."""
TRUSTED, BEYOND = 1e-6, 2.0
"""Error of a reduced model; where it says by how much it misses that, the most as a multiple of what it says."""
_SOLVER, _DRAWS = 4.0, 4  # roundings of a solver beside those of an entry, as in fmu.posterior.rounding


@dataclass
class Found:
    """What one model shows; errors are relative, of frequencies.

    Attributes
    ----------
    work : Work
    basis : int or None
        Vectors of the reduced model; None where the full model answers.
    error, reduced : float
        Largest error of the full model, and of the model that answers.
    roundings : float
        Largest error of the full model as a multiple of the rounding allowed by cancellation.
    said : tuple of str
        Sentences that fmu warned with.
    refused : str or None
        The sentence of a refusal.
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
    except np.linalg.LinAlgError:  # nothing is left of a soft part in the numbers of K
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
            found.faults.append(f"{getattr(found.work, name)} {name}, at most {getattr(MOST, name)}")
    found.basis = sum(problem.model.sizes) or None
    _compare(found, problem.model, theta, full, answered)
    if found.error > WARN * SD and not any(said.startswith("rounding: ") for said in found.said):
        found.faults.append(f"no word about a rounding error of {found.error:.1e}")
    return found


def _compare(found: Found, model: object, theta: FloatArray, full: FloatArray, answered: FloatArray) -> None:
    """Compare frequencies (n, MODES) of the full model and of the one that answers with extended precision."""
    told = re.search(r"frequencies are off by up to ([^ ;]+)", " ".join(found.said))
    allowed = BEYOND * float(told[1]) if told else largest_tolerance_elsewhere(model) or TRUSTED
    for point, of_full, of_answer in zip(theta, full, answered, strict=True):
        frequencies, rounding = exact(found.random, point)
        error, reduced = np.abs(of_full / frequencies - 1.0), np.abs(of_answer / frequencies - 1.0)
        found.error, found.reduced = max(found.error, error.max()), max(found.reduced, reduced.max())
        found.roundings = max(found.roundings, np.max(error / rounding))
        if not np.all(error <= ALLOWED * rounding):
            found.faults.append(f"full model: {of_full} Hz, not {frequencies}")
        if not np.all(reduced <= ALLOWED * rounding + allowed):
            found.faults.append(f"reduced model: {of_answer} Hz, not {frequencies}")


def exact(random: RandomModel, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest elastic frequencies in Hz, (MODES,), and the relative rounding that cancellation allows.

    Half of that of an eigenvalue: u |φ|ᵀ|K||φ|/λ, and √n u for the sums.
    """
    lam, phi = random.modes(theta, MODES)
    K = sum(abs(c) * abs(term.matrix) for c, term in zip(theta, random.model.K_terms, strict=True))
    sizes = np.sum(np.abs(phi) * (K[: len(phi), : len(phi)] @ np.abs(phi)), axis=0) / lam
    return in_hz(lam), 0.5 * np.finfo(float).eps * (sizes.astype(float) + len(phi) ** 0.5)


def refused_wrongly(random: RandomModel, start: FloatArray, sentence: str) -> list[str]:
    """Return what is wrong with a refusal: digits must be lost, and the sentence must say so.

    They are where rounding the entries of K, as often as a solver does, moves a frequency by its standard
    deviation.
    """
    if not sentence.startswith("rounding: "):
        return [f"refused: {sentence}"]
    rng, moved = np.random.default_rng(0), [0.0]
    try:
        exactly = in_hz(random.modes(start, MODES)[0])
        for _ in range(_DRAWS):
            changed = in_hz(random.modes(start, MODES, lambda K: rounded(K, rng))[0])
            moved.append(np.max(np.abs(changed / exactly - 1.0)))
    except np.linalg.LinAlgError:  # K is not positive any more
        return []
    return [] if _SOLVER * max(moved) > SD else [f"refused, but rounding moves frequencies by {max(moved):.1e}"]


def in_hz(lam: FloatArray) -> FloatArray:
    """Return frequencies in Hz."""
    return np.sqrt(lam.astype(float)) / (2.0 * np.pi)


def page(found: list[Found]) -> str:
    """Return the page in Markdown."""
    header = (
        "seed", "model", "factorisations", "eigenproblems", "solves", "basis", "error", "in roundings",
        "error of the reduced model", "fmu says",
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
    return (
        "# Forty random models\n\n"
        "Written by `make validate` (`python -m tests.validation.random_models results`). Each model is made from "
        "a seed: beams, springs and masses of 50 to 5000 degrees of freedom, free or held, with masses of four "
        "kinds, 1 to 20 terms over 0.1 to 8 decades of stiffness, double modes, parts that nothing holds, and "
        f"springs that are nearly singular (`tests/models/random_models.py`). {MODES} modes are measured with a "
        f"standard deviation of {significant(100 * SD)} %. Frequencies of the full model and of the reduced one "
        f"are compared at {POINTS} points with subspace iterations in extended precision "
        "(`tests/models/extended_precision.py`).\n\n"
        f"An error of the full model may be {ALLOWED:g} times the rounding that the cancellation in φᵀKφ allows; "
        f"one of the reduced model may be {significant(TRUSTED, 1)} more or, where fmu says that it misses this "
        f"tolerance, {BEYOND:g} times what it says. The budget of a model is {whole(MOST.factorisations)} "
        f"factorisations, {whole(MOST.eigenproblems)} eigenproblems of the full model and {whole(MOST.solves)} "
        "solves. A refusal is right where rounding the entries of K, as often as a solver does, moves a frequency "
        "by its standard deviation. Warnings of libraries are faults. Errors in the table are the "
        "largest, those of the full model in these roundings too; without a basis the full model answers.\n\n"
        f"Faults: {whole(len(faults))}. Refused: {whole(len(refused))} of {whole(len(found))}.\n\n"
        + "".join(f"{line}\n" for line in faults + refused)
        + ("\n" if faults or refused else "")
        + markdown_table(header, lines, words=(1, 9))
        + "\n"
    )


def kept_of(found: Found) -> dict[str, Any]:
    """Return what is kept of a model: all but the model, which follows from its seed."""
    return {f.name: getattr(found, f.name) for f in fields(found) if f.name != "random"} | {
        "work": asdict(found.work)
    }


def of_kept(kept: dict[str, Any]) -> Found:
    """Return a model from what is kept of it."""
    random = random_model(kept["seed"], MOST_DOFS)
    return Found(**kept | {"random": random, "work": Work(**kept["work"]), "said": tuple(kept["said"])})


def main() -> int:
    """Examine all models and write the page."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    found = units.completed("models", each(SEEDS), lambda seed: kept_of(examined(seed)), of_kept)
    (asked.out / "random-models.md").write_text(page(found), encoding="utf-8")
    return 1 if any(of.faults for of in found) or sum(of.refused is not None for of in found) > MOST_REFUSED else 0


if __name__ == "__main__":
    os.environ["FMU_CACHE_DIR"] = ""  # nothing from an earlier run
    sys.exit(main())
