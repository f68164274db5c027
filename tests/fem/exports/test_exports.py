"""Terms of K(θ) and M(θ) from matrices at several values of the parameters."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose

import fmu
from fmu.formats.models.exported import ExportedModel

N = 60
HALF = 30
DOFS = tuple((i // 2 + 1, "xz"[i % 2]) for i in range(N))
NOMINAL = {"E": 70e9, "t": 0.003, "E2": 2.1e11, "rho": 2700.0}


def assembled(first, last, seed):
    """Return a matrix of elements of six degrees of freedom each, which overlap, from `first` to `last`."""
    rng, K = np.random.default_rng(seed), np.zeros((N, N))
    for i in range(first, last - 5, 2):
        v = rng.standard_normal((6, 6))
        K[i : i + 6, i : i + 6] += v @ v.T
    return K


MEMBRANE, BENDING, OTHER = assembled(0, HALF, 1), assembled(0, HALF, 2), assembled(HALF - 4, N, 3)
OWN_MASS, REST = assembled(0, HALF, 4), assembled(0, N, 5)


def plate(E, t, E2, rho):
    """A plate of thickness t on one side, something else on the other; both share two nodes."""
    return E * (t * MEMBRANE + 1e4 * t**3 * BENDING) + E2 * OTHER, rho * t * OWN_MASS + REST


def as_exported(K, M, digits=None):
    if digits is not None:
        K, M = (np.vectorize(lambda x: float(f"{x:.{digits - 1}e}"))(one) for one in (K, M))
    nothing = np.zeros(0, dtype=np.int64)
    return ExportedModel(sp.csr_array(K), sp.csr_array(M), DOFS, nothing, np.zeros((0, 3)), (), ())


def exported(values=None, check=False, model=plate, digits=None, name=""):
    values = values or {}
    return fmu.Export(
        values or NOMINAL, as_exported(*model(**(NOMINAL | values)), digits), check=check, name=name or str(values)
    )


def design(step=1.2, check=True, **options):
    steps = [{"E": step}, {"t": step}, {"t": 2 - step}, {"E2": step}, {"rho": step}]
    made = [exported(**options)]
    made += [exported({name: NOMINAL[name] * s for name, s in one.items()}, **options) for one in steps]
    if check:
        at = {name: x * f for (name, x), f in zip(NOMINAL.items(), (0.7, 1.5, 1.2, 0.9), strict=True)}
        made.append(exported(at, check=True, **options))
    return made


def test_linear_and_cubic_terms_are_separated():
    """Membrane and bending of one plate, from four exports of it; a point never exported is reproduced."""
    model = fmu.from_exports(design())
    powers = {term.powers for term in model.K_terms}
    assert powers == {(1, 1, 0, 0), (1, 3, 0, 0), (0, 0, 1, 0)}
    assert {term.powers for term in model.M_terms} == {(0, 0, 0, 0), (0, 1, 0, 1)}
    assert model.names == tuple(NOMINAL)
    point = {"E": 5e10, "t": 0.0044, "E2": 2.9e11, "rho": 3100.0}
    K, M = plate(**point)
    theta = list(point.values())
    # rounding of the exports is multiplied by at most 20, the bound of the least squares there
    assert_allclose(model.K(theta).toarray(), K, rtol=0, atol=1e-12 * np.abs(K).max())
    assert_allclose(model.M(theta).toarray(), M, rtol=0, atol=1e-12 * np.abs(M).max())
    assert any("reproduced to" in said for said in model.notes)


def test_terms_have_only_the_entries_of_their_elements():
    """Rounding leaves nothing elsewhere, which would couple what is not coupled."""
    model = fmu.from_exports(design())
    bending = next(term.matrix for term in model.K_terms if term.powers == (1, 3, 0, 0))
    assert bending.nnz == np.count_nonzero(BENDING)
    assert_allclose(bending.toarray(), 1e4 * BENDING, rtol=0, atol=1e-11 * np.abs(1e4 * BENDING).max())


def test_the_thickness_of_a_solid():
    """Bricks between two faces have a part in 1/t."""

    def solid(E, t, E2, rho):
        return E * (t * MEMBRANE + 1e-5 / t * BENDING) + E2 * OTHER, rho * t * OWN_MASS + REST

    assert (1, -1, 0, 0) in {term.powers for term in fmu.from_exports(design(model=solid)).K_terms}


@pytest.mark.parametrize("names", [["E"], ["t"], ["t", "E2"]])
def test_what_is_no_polynomial_is_refused(names, monkeypatch):
    """A length or Poisson's ratio: the message has the export and the entries."""
    monkeypatch.setattr("fmu.fem.exports.recovery._MOST_TRIED", 300)

    def odd(E, t, E2, rho):
        given = {"E": E, "t": t, "E2": E2}
        factor = np.prod([np.sqrt(given[name] / NOMINAL[name]) for name in names])
        K, M = plate(E, t, E2, rho)
        return K + 1e9 * (factor - 1) * assembled(10, 20, 6), M

    with pytest.raises(ValueError, match="powers from -1 to 3") as refused:
        fmu.from_exports(design(model=odd))
    assert any(f"node {n} " in str(refused.value) for n in range(6, 11))


def test_the_check_turns():
    """What the exports used reproduce but the check does not: a product that only it shows."""

    def product(E, t, E2, rho):
        K, M = plate(E, t, E2, rho)
        return K + 1e9 * (E / 70e9 - 1) * (E2 / 2.1e11 - 1) * assembled(HALF - 4, HALF + 4, 7), M

    assert fmu.from_exports(design(check=False, model=product)).n_dof == N
    with pytest.raises(ValueError, match=r"must be the sum|powers from"):
        fmu.from_exports(design(model=product))


def test_without_a_check_nothing_shows_the_powers():
    said = " ".join(fmu.from_exports(design(check=False)).notes)
    assert "No export checks the stiffness" in said


def test_the_check_decides_where_the_exports_leave_powers_open():
    """One step of a parameter that enters with its cube is taken for linear, until the check says otherwise."""

    def cubic(E, t, E2, rho):
        return E * 1e4 * t**3 * BENDING + E2 * OTHER, rho * t * OWN_MASS + REST + t * OWN_MASS

    one_step = [one for k, one in enumerate(design(model=cubic)) if k != 3]
    model = fmu.from_exports(one_step)
    assert (1, 3, 0, 0) in {term.powers for term in model.K_terms}
    assert any("would be open" in said for said in model.notes)


@pytest.mark.parametrize(("digits", "told"), [(None, False), (6, True)])
def test_digits_are_told_where_they_matter(digits, told):
    said = " ".join(fmu.from_exports(design(digits=digits)).notes)
    assert (f"The {digits} digits of the exported stiffness" in said) == told


def test_what_is_told_of_the_digits_bounds_what_they_do():
    """The error of the lowest frequency at corners of the bounds, where it is largest."""
    rng, errors = np.random.default_rng(1), []
    model = fmu.from_exports(design(digits=6))
    told = float(re.search(r"Hz, to (\S+):", " ".join(model.notes))[1])
    for corner in rng.choice([0.5, 2.0], (12, 4)):
        theta = corner * list(NOMINAL.values())
        errors.append(lowest(model.K(theta).toarray(), model.M(theta).toarray()) / lowest(*plate(*theta)) - 1)
    assert np.std(errors) < told < 1000 * np.std(errors)


def lowest(K, M):
    values = np.linalg.eigvals(np.linalg.solve(M, K)).real
    return np.sqrt(values.min())


BROKEN = {
    "one": (lambda made: made[:1], "exports: must be at least 2"),
    "not alone": (
        lambda made: [made[0], *made[2:]],
        "exports: must have one, not kept for checking, in which only E differs from the first",
    ),
    "another mesh": (
        lambda made: [*made[:2], replace(made[2], model=replace(made[2].model, dofs=((99, "x"), *DOFS[1:])))],
        "exports.2: must have the degrees of freedom of the first export, 60 of one mesh .*node 1 x and node 99 x",
    ),
    "another order": (
        lambda made: [*made[:2], replace(made[2], model=replace(made[2].model, dofs=DOFS[::-1]))],
        r"exports.2: must have the degrees of freedom of the first export, .* \(got 60, in another order\)",
    ),
    "a motion less": (
        lambda made: [
            replace(made[0], model=replace(made[0].model, motions={(99, "x"): {DOFS[0]: 1.0}})),
            *made[1:],
        ],
        r"exports.1: must have the geometry of the first export \(the motion of node 99 x depends",
    ),
    "unknown": (lambda made: [*made, replace(made[1], values={"nu": 0.3})], "exports.7.values: must be of E, t"),
    "first is check": (
        lambda made: [replace(made[0], check=True), *made[1:]],
        "exports.0.check: must not be true",
    ),
    "no values": (lambda made: [replace(made[0], values={}), *made[1:]], "exports.0.values: must give"),
    "zero": (
        lambda made: [replace(made[0], values=NOMINAL | {"t": 0.0}), *made[1:]],
        "exports.0.values.t: must be finite, and not zero at first",
    ),
    "infinite": (
        lambda made: [*made, replace(made[1], values={"E": np.inf})],
        "values.E: must be a finite number",
    ),
    "no effect": (
        lambda made: [
            replace(made[0], values=NOMINAL | {"g": 9.81}),
            *made[1:],
            replace(made[0], values={"g": 9.0}),
        ],
        "exports: g must change the matrices",
    ),
    "together": (
        lambda made: [one for one in made if "t" not in one.values or one.check or len(one.values) > 1],
        "exports: must have one, not kept for checking, in which only t differs",
    ),
}


@pytest.mark.parametrize(("broken", "rule"), BROKEN.values(), ids=BROKEN)
def test_broken_exports(broken, rule):
    with pytest.raises(ValueError, match=rule):
        fmu.from_exports(broken(design()))


def test_parameters_that_only_change_together():
    """Two plates of one thickness: their stiffnesses in t and t³ cannot be told apart where they meet."""

    def two(E, t, E2, rho):
        return (E * MEMBRANE + E2 * OTHER) * t + 1e4 * t**3 * (E * BENDING + E2 * assembled(HALF - 4, N, 8)), REST

    made = [one for one in design(model=two) if "rho" not in one.values or len(one.values) > 1]
    made = [replace(one, values={k: v for k, v in one.values.items() if k != "rho"}) for one in made]
    with pytest.raises(ValueError, match=r"in which .*E.*E2.* are changed together"):
        fmu.from_exports(made[:-1])
    more = [exported({"E": 8e10, "t": t}, model=two) for t in (0.0024, 0.0036)]
    assert fmu.from_exports([*made, *more]).n_parameters == 3


@pytest.mark.parametrize("digits", [None, 6, 7])
def test_round_numbers_lose_no_entry(digits):
    def at(E):
        k = 1e5 * np.array([E, E, E, 1.0, 1.0, 1.0])
        K = np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
        if digits is not None:
            K = np.array([[float(f"{x:.{digits - 1}e}") for x in row] for row in K * 1.23456789])
        dofs = tuple((i + 1, "x") for i in range(6))
        none = np.zeros(0, dtype=np.int64), np.zeros((0, 3)), (), ()
        return ExportedModel(sp.csr_array(K), sp.csr_array(2.0 * np.eye(6)), dofs, *none)

    exports = [fmu.Export({"E": E}, at(E)) for E in (1.0, 1.2)] + [fmu.Export({"E": 0.8}, at(0.8), check=True)]
    model = fmu.from_exports(exports)
    for E in (0.7, 1.0, 1.9):
        expected = at(E).stiffness.toarray()
        assert_allclose(
            model.K([E]).toarray(), expected, atol=(1e-12 if digits is None else 1e-4) * expected.max()
        )
    assert not [note for note in model.notes if "digits" in note] or digits is not None


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({"F": (1.0, 2.0)}, r"bounds: must be of E, t, E2 and rho \(got F\)"),
        ({"E": (2e11, 1e10)}, r"bounds\.E: must be two numbers in ascending order"),
    ],
)
def test_bounds_of_no_parameter_or_in_no_order_are_refused(bounds, message):
    with pytest.raises(ValueError, match=message):
        fmu.from_exports(design(), bounds=bounds)
