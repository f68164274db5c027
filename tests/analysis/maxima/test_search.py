"""Every maximum with its curvature and mass, against integrals over a grid and against sampling."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import simpson

import fmu
from fmu.analysis.maxima import search
from fmu.analysis.maxima.mode_weights import mode_weights
from fmu.analysis.maxima.results import Maxima, theta_in_words
from fmu.analysis.maxima.search import STARTS, STARTS_WITHOUT_DERIVATIVES, default_starts, find_map, hessian_at
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.samplers.mixture.quadratic import Quadratic


class Squares:
    """f = (θ₀², θ₁): the sign of θ₀ cannot be told, so that there are two maxima."""

    n_parameters = n_modes = 2

    def frequencies(self, theta):
        return np.stack([theta[:, 0] ** 2, theta[:, 1]], axis=1)

    def frequencies_and_gradient(self, theta):
        slopes = np.zeros((len(theta), 2, 2))
        slopes[:, 0, 0], slopes[:, 1, 1] = 2 * theta[:, 0], 1.0
        return self.frequencies(theta), slopes


def squares(b_measured=2.5, b_lower=0.0, sd=1.0, beta=0.2):
    """The prior's mean at 0.5 makes the positive maximum the higher one; θ₁ is pressed against its bound."""
    parameters = [
        Parameter("a", 1.5, -3.0, 3.0, prior=Normal(sd, mean=0.5), unit="m"),
        Parameter("b", 1.0, b_lower, 2.0, prior=Normal(1.0, mean=1.0)),
    ]
    data = ModalData([4.0, b_measured], labels=("first", "second"))
    return UpdatingProblem(Squares(), data, parameters, beta=[beta, 2.0])


def on_grid(problem, split=0.0):
    """Return log mass, mean and sd on either side of θ₀ = `split`, the lower side first."""
    found = []
    for low, high in ((problem.lower[0], split), (split, problem.upper[0])):
        x, y = np.linspace(low, high, 801), np.linspace(problem.lower[1], problem.upper[1], 801)
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        p = np.exp(problem.log_prob(points.reshape(-1, 2))).reshape(801, 801)
        total = simpson(simpson(p, y), x)
        moments = [
            [simpson(simpson(p * points[..., k] ** power, y), x) / total for k in range(2)] for power in (1, 2)
        ]
        sd = np.sqrt(np.array(moments[1]) - np.array(moments[0]) ** 2)
        found.append((np.log(total), np.array(moments[0]), sd))
    return found


def test_two_maxima_of_comparable_mass():
    problem = squares()
    found = find_map(problem, starts=32)
    (low_mass, low_mean, low_sd), (high_mass, high_mean, high_sd) = on_grid(problem)
    assert len(found) == 2
    total = np.logaddexp(low_mass, high_mass)
    assert found.log_evidence == pytest.approx(total, abs=0.06)
    assert 0.1 < found[1].share < 0.4
    for m, mass, mean, sd in zip(
        found, (high_mass, low_mass), (high_mean, low_mean), (high_sd, low_sd), strict=True
    ):
        assert m.effective_draws > 200
        assert m.log_mass == pytest.approx(mass, abs=0.1)
        assert m.share == pytest.approx(np.exp(mass - total), abs=0.03)
        np.testing.assert_allclose((m.mean - mean) / sd, 0.0, atol=0.2)
        np.testing.assert_allclose(m.sd, sd, rtol=0.15)


def test_mass_counts_and_not_height():
    """θ₀² is known well at the higher maximum only when mirrored: a wide flank outweighs a high, narrow peak."""

    class TwoWidths(Squares):
        def frequencies(self, theta):
            x = theta[:, 0]
            return np.stack([np.where(x > 0, 40.0 * (x - 2.0), x + 2.0), theta[:, 1]], axis=1)

        def frequencies_and_gradient(self, theta):
            slopes = np.zeros((len(theta), 2, 2))
            slopes[:, 0, 0], slopes[:, 1, 1] = np.where(theta[:, 0] > 0, 40.0, 1.0), 1.0
            return self.frequencies(theta), slopes

    parameters = [Parameter("a", 1.5, -3.0, 3.0, prior=Normal(2.0, mean=2.0)), Parameter("b", 1.0, 0.0, 2.0)]
    problem = UpdatingProblem(TwoWidths(), ModalData([1e-3, 1.0]), parameters, beta=2.0)
    found = find_map(problem, starts=64)
    narrow, wide = found[0], found[1]
    assert narrow.theta[0] > 0 > wide.theta[0]
    (wide_mass, *_), (narrow_mass, *_) = on_grid(problem)
    assert narrow.log_prob > wide.log_prob
    assert wide.share > 0.75
    assert wide.log_mass - narrow.log_mass == pytest.approx(wide_mass - narrow_mass, abs=0.15)


def test_fields_of_a_maximum():
    problem = squares()
    best = find_map(problem, starts=16)[0]
    assert best.log_prob == problem.log_prob(best.theta)
    np.testing.assert_array_equal(best.frequencies, problem.frequencies(best.theta))
    np.testing.assert_array_equal(best.at_bound, [0, 1])
    np.testing.assert_allclose(best.gradient, problem.log_prob_and_grad(best.theta)[1])
    # exact second derivatives: −∂²(−β(x² − 4)²) = 4β(3x² − 4), prior 1; 2β and prior 1
    expected = np.diag([0.8 * (3 * best.theta[0] ** 2 - 4.0) + 1.0, 5.0])
    np.testing.assert_allclose(best.hessian, expected, rtol=1e-3, atol=1e-6)
    assert best.curvature == "differences"


def test_drop_is_the_quadratic_model():
    found = find_map(squares(), starts=16)
    step = np.array([[0.1, -0.2], [0.0, 0.0]])
    drop = found.drop(found[0].theta + step)
    d, m = step[0], found[0]
    assert drop.shape == (len(found), 2)
    np.testing.assert_allclose(drop[0], [0.5 * d @ m.hessian @ d - d @ m.gradient, 0.0])


def test_lower_bound_is_told_apart():
    found = find_map(squares(b_measured=0.2, b_lower=0.8), starts=16)
    np.testing.assert_array_equal(found[0].at_bound, [0, -1])
    assert found.words_at_bounds(found[0]) == "b lower"


def test_hessian_at_a_kink_is_gauss_newton():
    class Kink(Squares):
        def frequencies(self, theta):
            return np.stack([10.0 + np.abs(theta[:, 0]), theta[:, 1]], axis=1)

        def frequencies_and_gradient(self, theta):
            slopes = np.zeros((len(theta), 2, 2))
            slopes[:, 0, 0], slopes[:, 1, 1] = np.sign(theta[:, 0]), 1.0
            return self.frequencies(theta), slopes

    parameters = [Parameter("a", 1.5, -3.0, 3.0), Parameter("b", 1.0, 0.0, 2.0)]
    problem = UpdatingProblem(Kink(), ModalData([9.0, 1.0]), parameters, beta=2.0)
    hessian, source = hessian_at(problem, np.array([1e-9, 1.0]))
    assert source == "Gauss-Newton"
    np.testing.assert_allclose(hessian, np.diag([4.0 * 6.0**2, 4.0 * 2.0**2]), rtol=1e-6)


def test_hopeless_maxima_keep_their_laplace_mass():
    """Beside a peak e⁵⁰ times as heavy lies one at a wall, exponential there, for which no solve is spent."""
    peak = Quadratic(np.array([0.3]), 50.0, np.zeros(1), np.array([[400.0]]))
    wall = Quadratic(np.array([1.0]), 0.0, np.array([30.0]), np.array([[0.0]]))
    calls = []

    def log_prob(u):
        calls.append(len(u))
        return peak(u)

    one, other = mode_weights(log_prob, [peak, wall], np.zeros(1), np.ones(1), np.random.default_rng(0))
    assert one.effective > 300
    assert one.log_mass == pytest.approx(50.0 + 0.5 * np.log(2 * np.pi / 400.0), abs=0.05)
    assert (other.effective, other.evidence_covariance) == (0, 0)
    assert other.log_mass == pytest.approx(np.log(1.0 / 30.0), abs=0.02)
    assert other.mean[0] == pytest.approx(1 - 1 / 30, abs=0.005)
    assert sum(calls) == 1024


@pytest.mark.parametrize(
    "apart", [0.0, 3.0, pytest.param(10.0, marks=pytest.mark.validate)], ids=["one", "overlapping", "separate"]
)
def test_the_error_of_the_total_mass_is_that_of_replicates(apart):
    """200 replicates give the standard deviation with a relative standard error of 1/√(2·200)."""
    centres = [np.zeros(2), np.full(2, apart)] if apart else [np.zeros(2)]
    peaks = [Quadratic(centre, 0.0, np.zeros(2), np.eye(2)) for centre in centres]
    wide = np.full(2, 30.0)

    def log_prob(u):
        squares = np.stack([np.sum((u - centre) ** 2, axis=1) for centre in centres])
        return np.logaddexp.reduce(-0.5 * squares - 0.05 * squares**2, axis=0)

    totals, variances = [], []
    for seed in range(200):
        found = mode_weights(log_prob, peaks, -wide, wide, np.random.default_rng(seed), draws=128)
        log_mass = np.array([one.log_mass for one in found])
        totals.append(np.logaddexp.reduce(log_mass))
        variances.append(np.exp(log_mass - totals[-1]) @ [one.evidence_covariance for one in found])
    assert np.sqrt(np.mean(variances)) == pytest.approx(np.std(totals), rel=5 / np.sqrt(400))


@pytest.mark.parametrize(("few", "curvature"), [(0, "Gauss-Newton"), (20, "differences")])
def test_few_solves_are_spent_on_a_maximum_without_probability(monkeypatch, few, curvature):
    """The prior of θ₀ makes one of two maxima e³² times as probable: of the other there are no draws."""
    monkeypatch.setattr(search, "_FEW", few)
    rows, solved, frequencies = list[int](), list[int](), Squares.frequencies

    def counted(self, theta):
        rows.append(len(theta))
        return frequencies(self, theta)

    monkeypatch.setattr(Squares, "frequencies", counted)
    for sd in (2.0, 0.25):
        rows.clear()
        problem = squares(sd=sd, beta=200.0)
        found = find_map(problem, starts=32)
        assert [round(float(m.theta[0])) for m in found] == [2, -2]
        solved.append(sum(rows))
        if sd == 0.25:
            assert found[1].share < 1e-12
            assert [m.effective_draws > 0 for m in found] == [True, False]
            assert [m.curvature for m in found] == ["differences", curvature]
        else:
            assert all(m.curvature == "differences" for m in found)
            assert all(m.effective_draws > 0 for m in found)
    assert solved[1] < solved[0] - 900


def test_section_by_number_has_its_mass_in_a(section_maxima):
    heights = [m.log_prob for m in section_maxima]
    np.testing.assert_allclose(heights[:3], [-40.43, -107.90, -114.61], atol=0.01)
    assert section_maxima[0].share > 1 - 1e-12
    assert all(m.share < 1e-12 for m in section_maxima[1:])
    assert section_maxima.words_at_bounds(section_maxima[0]) == "Ix2 upper, Ax1 upper"
    np.testing.assert_allclose(section_maxima[0].mean, [3.910e-9, 7.485e-9, 8.995e-4, 5.149e-4], rtol=1e-3)


@pytest.mark.validate
def test_moments_around_a_maximum_are_those_of_sampling(section, section_maxima):
    start = np.repeat(section_maxima[0].theta[None], 4, axis=0)
    trace = fmu.sample(section, "hmc", draws=250, warmup=200, init=start, seed=2)
    table = fmu.summary(trace)
    best = section_maxima[0]
    error = np.hypot(table["mcse_mean"], best.sd / np.sqrt(best.effective_draws))
    assert np.all(np.abs(best.mean - table["mean"]) < 5 * error)
    np.testing.assert_allclose(best.sd, table["sd"], rtol=0.3)


def test_table(section_maxima):
    table = section_maxima.table()
    assert list(table.index) == list(range(1, len(section_maxima) + 1))
    assert list(table.columns[:8]) == ["log_prob", "share", "starts", "at_bounds", "Ix1", "Ix2", "Ax1", "Ax2"]
    assert list(table.columns[-5:]) == [f"{label}_hz" for label in section_maxima.labels]
    assert table.loc[1, "Ix1_sd"] == section_maxima[0].sd[0]
    assert table.loc[1, "at_bounds"] == "Ix2 upper, Ax1 upper"
    assert table.attrs["units"] == {"Ix1": "m⁴", "Ix2": "m⁴", "Ax1": "m²", "Ax2": "m²"}


def test_words(section, section_maxima):
    """A column per maximum, beside the model before updating and the measurement."""
    words = section_maxima.side_by_side(most=2)
    assert list(words.columns) == ["unit", "before", "maximum 1", "maximum 2", "measured"]
    assert words.loc["log-probability", "maximum 2"] == "-107.9"
    assert words.loc["share of probability", "maximum 1"] == "100 %"
    assert section_maxima.at_bounds()[0] == "Maximum 1 lies at bounds: Ix2 upper, Ax1 upper."
    assert list(words.loc["Ix1"]) == ["mm⁴", "7000", "3904", "6873", ""]
    assert list(words.loc["mode 1"]) == ["Hz", "32.00", "28.77", "30.15", "31.9"]
    assert section_maxima.side_by_side().shape[1] == 3 + len(section_maxima)
    assert "3904" in str(section_maxima)
    html = section_maxima._repr_html_()
    assert html.startswith("<table")
    assert "3904" in html
    words = theta_in_words(section_maxima.names, section_maxima[0].theta, section_maxima.units)
    assert words.startswith("Ix1 = 3904 mm⁴, Ix2 = 7500 mm⁴")


def test_low_frequencies_of_several_maxima_differ_in_the_table(section_maxima):
    """Two decimals would read 0.10, 0.10 and 0.10 Hz."""
    found = replace(
        section_maxima,
        maxima=tuple(
            replace(m, frequencies=m.frequencies * (0.1 + 1e-4 * k) / m.frequencies[0])
            for k, m in enumerate(section_maxima)
        ),
        before=section_maxima.before * 0.1003 / section_maxima.before[0],
        measured=section_maxima.measured * 0.1 / section_maxima.measured[0],
    )
    assert list(found.side_by_side(most=2).loc["mode 1"]) == ["Hz", "0.1003", "0.1000", "0.1001", "0.1"]


@pytest.mark.parametrize("parameters", [4, 11])
@pytest.mark.parametrize("count", [1, 6])
def test_the_table_fits_a_terminal(section_maxima, parameters, count):
    k = np.arange(parameters) % 4
    one = replace(
        section_maxima[0],
        theta=section_maxima[0].theta[k],
        sd=section_maxima[0].sd[k],
        at_bound=np.ones(parameters, dtype=int),
    )
    found = replace(
        section_maxima,
        maxima=(one,) * count,
        names=tuple(f"m drum weights {i}" for i in range(parameters)),
        units=("N·m/rad",) * parameters,
        start=section_maxima.start[k],
    )
    lines = str(found).splitlines()
    assert max(map(len, lines)) <= 100
    assert sum(f"m drum weights {parameters - 1} " in line and "upper" not in line for line in lines) in (1, 2)
    assert " ".join(str(found).split()).count(f"m drum weights {parameters - 1} upper") == count


def test_dataset_and_back(section_maxima, tmp_path):
    import xarray as xr

    section_maxima.to_dataset().to_netcdf(tmp_path / "m.nc", engine="h5netcdf")
    back = Maxima.from_dataset(xr.load_dataset(tmp_path / "m.nc", engine="h5netcdf"))
    assert str(back) == str(section_maxima)
    for one, other in zip(section_maxima, back, strict=True):
        np.testing.assert_array_equal(one.hessian, other.hessian)
        np.testing.assert_array_equal(one.at_bound, other.at_bound)
        assert (one.curvature, one.log_mass, one.starts) == (other.curvature, other.log_mass, other.starts)
    for name in ("lower", "upper", "start", "measured", "before"):
        np.testing.assert_array_equal(getattr(back, name), getattr(section_maxima, name))
    assert (back.names, back.units, back.labels) == (
        section_maxima.names,
        section_maxima.units,
        section_maxima.labels,
    )


def test_same_seed_gives_the_same_maxima():
    problem = squares()
    assert str(find_map(problem, 16, seed=3)) == str(find_map(problem, 16, seed=3))
    assert find_map(problem, 16, seed=3).log_evidence != find_map(problem, 16, seed=4).log_evidence


def test_bad_arguments(plain):
    with pytest.raises(ValueError, match=r"problem: must be a LogDensity \(got namespace"):
        find_map(plain)
    with pytest.raises(ValueError, match="starts: must be a whole number of at least 1"):
        find_map(squares(), starts=0)


def test_a_search_without_derivatives_takes_fewer_starts():
    slow = Squares()
    slow.solves_per_gradient = 5
    parameters = squares().parameters
    data = ModalData([4.0, 2.5], labels=("first", "second"))
    assert default_starts(squares()) == STARTS
    assert default_starts(UpdatingProblem(slow, data, parameters)) == STARTS_WITHOUT_DERIVATIVES < STARTS
    assert sum(m.starts for m in find_map(UpdatingProblem(slow, data, parameters))) == STARTS_WITHOUT_DERIVATIVES
