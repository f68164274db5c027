"""K(θ) of unit runs and of perturbed exports, against the program's own stiffness at values never exported.

``python -m tests.programs.unit_runs`` prints the largest error of an entry, relative to √(K_ii K_jj), by program
and way. MYSTRAN writes binary matrices of a plate with an RBE2, an RBE3 and an MPC in a chain; CalculiX writes
text.
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from fmu.config import read
from fmu.formats.decks import fill_deck
from fmu.formats.models.read import read_model
from tests.programs.calculix_plate import plate as calculix_plate
from tests.programs.test_constraints_mystran import NOMINAL, PLATES
from tests.programs.test_constraints_mystran import plate as mystran_plate

NEW = {"E1": 1.83e11, "E2": 2.27e11, "E3": 8.1e10}
OTHER = {"E1": 2.5e11, "E2": 2.5e11, "E3": 9e10}


def mystran_template():
    """Return the deck of shells and bars with {E1}, {E2} and {E3}; bushing and masses have no parameter."""
    text = mystran_plate(NOMINAL, output="KGG,MGG", **PLATES["chain"])
    for k in (1, 2, 3):
        card = f"MAT1*{k:>19d}"
        assert card in text
        text = text.replace(f"{card}{NOMINAL[f'E{k}']:16.9E}", f"{card}{{E{k}:16}}")
    return text


def calculix_template():
    """Return the deck of two halves of a plate with {E1} and {E2}."""
    text = calculix_plate(", SOLVER=MATRIXSTORAGE", E_left=3e11, E_right=5e11)
    return text.replace("300000000000.0, 0.3", "{E1}, 0.3").replace("500000000000.0, 0.3", "{E2}, 0.3")


PROGRAMS = {
    "MYSTRAN": ("job.bdf.in", ["mystran", "{deck}"], "{job}.OU1", mystran_template, ("E1", "E2", "E3")),
    "CalculiX": ("job.inp.in", ["ccx", "{job}"], "{job}.sti", calculix_template, ("E1", "E2")),
}


def problem(program, folder, perturbed=False):
    """Write a problem file with [model.runs], unit runs or exports with one modulus changed; return its path."""
    template, command, stiffness, text, names = PROGRAMS[program]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / template).write_text(text())
    lines = ['name = "plate"', "[model]", 'type = "exports"', "[model.runs]", f'template = "{template}"']
    lines += [f"command = {command}", f'stiffness = "{stiffness}"']
    if perturbed:
        first = ", ".join(f"{name} = {NOMINAL[name]!r}" for name in names)
        steps = [first, *(f"{name} = {OTHER[name]!r}" for name in names)]
        lines += [f"[[model.exports]]\nvalues = {{ {one} }}" for one in steps]
    lines += ["[measurement]", "frequencies = [8.0, 40.0]", "sd = [0.1, 0.4]"]
    for name in names:
        lines += ["[[parameters]]", f'name = "{name}"', f"start = {NOMINAL[name]!r}"]
        lines += [f"lower = {0.6 * NOMINAL[name]!r}", f"upper = {1.5 * NOMINAL[name]!r}"]
    path = folder / "plate.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def model_of(path):
    """Return the model of a problem file, before any reduction."""
    file = read(path)
    return file.model.build(path.parent, file.parameters).model


def own(program, folder, model):
    """Return the stiffness that the program writes at the values NEW, by one more run."""
    from fmu.fem.programs.deck_run import DeckRun

    template, command, stiffness, _, names = PROGRAMS[program]
    run, wrong = DeckRun.of(names, template, command, (), 60.0, folder)
    assert not wrong
    place = folder / "own"
    assert not run.execute({name: NEW[name] for name in names}, place)
    assert fill_deck(run.template, NEW) == (place / run.deck).read_text()
    read = read_model(run.find_output(stiffness, place), mesh=place / run.deck)
    assert read.dofs == model.dofs
    return read


def error_of(program, folder, perturbed=False):
    """Return the largest error of an entry of K(θ) at NEW, relative to √(K_ii K_jj)."""
    model = model_of(problem(program, folder, perturbed))
    exact = own(program, folder, model).stiffness
    scale = np.sqrt(exact.diagonal())
    away = abs(model.K([NEW[name] for name in model.names]) - exact).tocoo()
    return float(np.max(away.data / (scale[away.row] * scale[away.col]), initial=0.0))


def main():
    with tempfile.TemporaryDirectory() as folder:
        for program in PROGRAMS:
            if program == "CalculiX" and shutil.which("ccx") is None:
                continue
            for perturbed in (False, True):
                way = "exports, one modulus changed" if perturbed else "unit runs"
                error = error_of(program, Path(folder) / f"{program}-{perturbed}", perturbed)
                print(f"{program:9s} {way:30s} {error:.1e}")


if __name__ == "__main__":
    main()
