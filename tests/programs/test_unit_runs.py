"""`[model.runs]` with MYSTRAN and CalculiX: K_j of unit runs give the program's own stiffness anywhere."""

import shutil

import pytest

import fmu
from fmu.config import ConfigurationError
from tests.programs.unit_runs import PROGRAMS, error_of, model_of, problem


# MYSTRAN's matrices are binary (measured: 7e-16), CalculiX writes 14 digits (6e-14)
@pytest.mark.parametrize(("program", "most"), [("MYSTRAN", 1e-14), ("CalculiX", 1e-12)])
def test_the_own_stiffness_at_values_that_were_not_exported(program, most, tmp_path):
    if shutil.which(PROGRAMS[program][1][0]) is None and program == "CalculiX":
        pytest.skip("needs CalculiX (ccx)")
    assert error_of(program, tmp_path) < most
    model = model_of(tmp_path / "plate.toml")  # from the runs that are kept
    constant = {(0,) * len(model.names)} if program == "MYSTRAN" else set()  # a bushing
    alone = {tuple(int(i == j) for j in range(len(model.names))) for i in range(len(model.names))}
    assert {term.powers for term in model.K_terms} == constant | alone


def test_a_thickness_is_refused_in_unit_runs(tmp_path):
    """A shell without transverse shear has terms in t and t³."""
    path = problem("MYSTRAN", tmp_path)
    template = tmp_path / "job.bdf.in"
    text = template.read_text()
    assert "PSHELL,2,2,0.00800,2" in text
    template.write_text(text.replace("PSHELL,2,2,0.00800,2", "PSHELL,2,2,{t},2"))
    path.write_text(path.read_text() + '[[parameters]]\nname = "t"\nstart = 0.008\nlower = 0.006\nupper = 0.01\n')
    with pytest.raises(ConfigurationError, match=r"model\.exports: .* t"):
        fmu.load(path)
