"""Problems in another process: the same answers in every bit, whatever they are made of."""

import pickle

import numpy as np
import pytest

import fmu
from fmu.config.mistakes import BrokenError
from fmu.engines.process_pool import ProcessPool
from tests.shear_building import shear_building, storey

K = [storey(j, 4) for j in range(4)]
SENSORS = [(0, "x"), (2, "x"), (3, "x")]
FREQUENCIES = [1.61, 4.52, 6.98]
SHAPES = [[0.29, -0.83, 0.98], [0.79, -0.42, -1.00], [1.01, 0.99, 0.93]]
MASS = np.diag([1.0, 1.1, 0.9, 1.0])


def modes_of(theta):
    """Give the frequencies of the chain and what the sensors see; fail where the lower storeys are soft."""
    if theta[0] < 0.55:
        raise ValueError("too soft")
    size = 1.0 / np.sqrt(np.diag(MASS))
    matrix = 1000.0 * (theta[0] * (K[0] + K[1]) + theta[1] * (K[2] + K[3]))
    lam, y = np.linalg.eigh(size[:, None] * matrix * size)
    return {"frequencies": np.sqrt(lam) / (2 * np.pi), "shapes": (size[:, None] * y)[[0, 2, 3]]}


def chain(**settings):
    building = shear_building(["lower", "lower", "upper", "upper"], 1000.0, MASS)
    model = settings.pop("model", None) or building
    data = fmu.ModalData(FREQUENCIES, sensors=SENSORS, shapes=SHAPES, **settings.pop("data", {}))
    priors = settings.pop("priors", (fmu.Uniform(), fmu.Uniform()))
    parameters = [
        fmu.Parameter(name, start=1.0, lower=0.5, upper=1.5, prior=prior)
        for name, prior in zip(("lower", "upper"), priors, strict=True)
    ]
    return fmu.UpdatingProblem.reduced(model, data, parameters, **settings)


def noise(name):
    return fmu.Parameter(name, start=0.02, lower=0.0, upper=1.0, prior=fmu.HalfNormal(0.05))


def from_file(folder):
    """Return a problem with a function of a module that imports another one beside it."""
    (folder / "stiffness.py").write_text("import numpy as np\n\nK = np.array([[2.0, -1.0], [-1.0, 1.0]])\n")
    (folder / "storeys.py").write_text(
        "import numpy as np\nfrom stiffness import K\n\n\n"
        "def modes(theta):\n    return np.sqrt(theta[0] * np.linalg.eigvalsh(K))\n"
    )
    (folder / "file.toml").write_text(
        'name = "storeys"\n\n[model]\ntype = "python"\nfunction = "storeys:modes"\n\n'
        "[measurement]\nfrequencies = [0.6, 1.6]\nsd = 0.1\n\n"
        '[[parameters]]\nname = "k"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
    )
    return fmu.load(folder / "file.toml")


def garteur(folder):
    """Return the aeroplane with its rigid arms, not reduced."""
    text = fmu.cases.path("garteur").read_text(encoding="utf-8")
    (folder / "garteur.toml").write_text(
        text.replace("[model]", "reduction = false\n\n[model]", 1), encoding="utf-8"
    )
    return fmu.load(folder / "garteur.toml")


PROBLEMS = {
    **{
        f"{name} by {pairing}": lambda _, name=name, pairing=pairing: fmu.cases.load(name, pairing)
        for name in ("cantilever-young", "cantilever-section")
        for pairing in ("shape", "index")
    },
    "cantilever-young softly": lambda _: fmu.cases.load("cantilever-young", "soft"),
    "shear-2dof": lambda _: fmu.cases.load("shear-2dof"),
    "shear-10dof": lambda _: fmu.cases.load("shear-10dof"),
    "garteur": garteur,
    "not reduced": lambda _: chain(reduction=False),
    "softly": lambda _: chain(pairing="soft"),
    "frequencies and shapes": lambda _: chain(
        error=[fmu.FrequencyErrors(sd=noise("frequency")), fmu.ShapeErrors(sd=noise("shape"))]
    ),
    "MAC": lambda _: chain(error=[fmu.FrequencyErrors(sd=0.02), fmu.MACErrors(sd=noise("MAC"))]),
    "modal residual": lambda _: chain(error="modal-residual", beta=10.0),
    "priors": lambda _: chain(
        priors=(fmu.Normal(sd=0.1, mean=1.0), fmu.LogNormal(median=1.0, sigma=0.2)), reduction=False
    ),
    "function": lambda _: chain(model=fmu.BlackBoxModel(modes_of, 2)),
    "function of a notebook": lambda _: chain(model=fmu.BlackBoxModel(lambda theta: modes_of(theta), 2)),
    "function of a file": from_file,
}


def answers(problem, theta, report=None):
    return problem.log_prob(theta), *problem.log_prob_and_grad(theta), problem.frequencies(theta)


@pytest.fixture(scope="module")
def pool():
    with ProcessPool(1) as pool:
        yield pool


LIKE_OTHERS = ("cantilever-young by index", "cantilever-section by shape", "cantilever-young softly")
"""Cases whose structure, pairing or likelihood another problem has too."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.validate] * (name in LIKE_OTHERS)) for name in PROBLEMS]
)
def test_answers_are_the_same_in_every_bit(pool, name, tmp_path):
    problem = PROBLEMS[name](tmp_path)
    theta = problem.sample_prior(np.random.default_rng(1), 6)
    if np.isfinite(problem.upper[0]):
        theta[-1, 0] = problem.upper[0] + 0.1 * problem.scale[0]  # where the full model answers
    here = answers(problem, theta)
    there = pool.run_tasks(answers, problem, [theta])[0]
    assert np.isfinite(here[0][:-1]).any()
    for mine, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_a_reduced_problem_is_sent_without_what_is_prepared_when_needed():
    problem = fmu.cases.load("cantilever-young")
    before = len(pickle.dumps(problem))
    answers(problem, problem.start)
    assert len(pickle.dumps(problem)) == before < 250_000


def test_a_function_of_a_file_travels_by_its_place(tmp_path):
    problem = from_file(tmp_path)
    function = problem.model.functions[0].function
    again = pickle.loads(pickle.dumps(function))
    np.testing.assert_array_equal(again(np.array([1.2])), function(np.array([1.2])))
    assert repr(again) == "Imported('storeys:modes')"
    assert again.__wrapped__ is not function.__wrapped__
    (tmp_path / "storeys.py").write_text("")
    with pytest.raises(BrokenError, match="must be in"):
        pickle.loads(pickle.dumps(function))
