"""When the verdict on the model turns: by each kind of check on a linear model, whose posteriors are exact."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binom, chi2, norm
from scipy.stats import t as student

import fmu
from fmu.analysis.convergence.diagnosis import judge
from fmu.analysis.fit.check import HELD_OUT, LEVEL, NOISE, PREDICTED, RESIDUALS, SHAPE
from fmu.analysis.fit.deviations import deviation_warnings
from fmu.analysis.fit.model_fit import CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE, UNKNOWN, model_fit
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.trace.modal_states import MEASURED
from fmu.numbers import change
from tests.linear import SLOPES, LinearModel

PRIOR_SD, SD = np.array([1.0, 2.0]), np.array([0.1, 0.1, 0.1])
TRUTH = np.array([0.6, -0.9])
FITTED = 100.0 + SLOPES @ TRUTH
DRAWS = (4, 500)
RIGHT_MODELS = 1000


def posterior(y, kept):
    """Return mean and covariance of the parameters from the modes `kept`."""
    A = SLOPES[kept] / SD[kept][:, None]
    C = np.linalg.inv(A.T @ A + np.diag(PRIOR_SD**-2.0))
    return C @ A.T @ ((y[kept] - 100.0) / SD[kept]), C


def left_out(y, used):
    """Return the table of `leave_one_out`: exact predictions of each mode from the other used ones."""
    rows = []
    for k in range(3):
        mean, C = posterior(y, [i for i in used if i != k])
        at, sd = 100.0 + SLOPES[k] @ mean, np.sqrt(SLOPES[k] @ C @ SLOPES[k] + SD[k] ** 2)
        before = np.sqrt(np.sum((SLOPES[k] * PRIOR_SD) ** 2) + SD[k] ** 2)
        p = 2.0 * norm.sf(abs(y[k] - at) / sd)
        rows.append(
            (
                y[k],
                at,
                sd,
                at - 1.6449 * sd,
                at + 1.6449 * sd,
                p,
                np.inf,
                before,
                0.0,
                0.0,
                0.1,
                "refit",
                k in used,
            )
        )
    names = ("measured", "mean", "sd", "eti90_lb", "eti90_ub", "p", "freedom", "prior_sd", "elpd", "mcse_elpd",
             "pareto_k", "method", "used")  # fmt: skip
    columns = {
        name: ("mode", np.array(column)) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    return xr.Dataset(columns, coords={"mode": ["W1", "W2", "T1"]})


@pytest.fixture
def fit_of(make_result):
    """The verdict for measured frequencies, with exact draws and predictions."""

    def make(y, used=(0, 1, 2), table=left_out, of=model_fit):
        parameters = [fmu.Parameter(n, 0.0, prior=fmu.Normal(s)) for n, s in zip("ab", PRIOR_SD, strict=True)]
        data = fmu.ModalData(y, labels=("W1", "W2", "T1"), sd_hz=SD, use=[k in used for k in range(3)])
        problem = fmu.UpdatingProblem(LinearModel(), data, parameters)
        draws = np.random.default_rng(4).multivariate_normal(*posterior(y, list(used)), DRAWS)
        trace = to_trace(make_result(draws), problem)
        if table is not None:
            trace["leave_one_out"] = xr.DataTree(table(y, list(used)))
        return of(trace)

    return make


def kinds(fit):
    return {check.kind for check in fit.checks if check.failed}


def test_a_model_that_fits(fit_of):
    fit = fit_of(FITTED + np.array([0.05, -0.1, 0.08]))
    assert (fit.verdict, fit.answer, fit.against) == (NOT_CONTRADICTED, "not contradicted", ())
    assert [check.kind for check in fit.checks] == [PREDICTED] * 3 + [RESIDUALS]
    assert "3 data, 2 parameters: 1 degree of freedom left." in fit.reasons


@pytest.mark.parametrize(("off", "verdict"), [(0.25, NOT_CONTRADICTED), (0.5, CONTRADICTED)])
def test_one_frequency_that_the_others_contradict(fit_of, off, verdict):
    """Two parameters follow it in part: the residuals hide what the predictions show."""
    fit = fit_of(FITTED + np.array([0.0, off, 0.0]))
    assert fit.verdict == verdict
    if verdict == CONTRADICTED:
        assert PREDICTED in kinds(fit)
        assert fit.against[0].startswith("mode W")
        assert "the other modes predict" in fit.against[0]
        assert fit.answer == f"contradicted by {len(fit.against)} of 4 checks"


@pytest.mark.parametrize("side", ["below", "above"])
def test_the_errors_that_would_have_been_found(fit_of, side):
    """The mode is moved as far as the check says, from where the others predict it: there the verdict turns."""
    row = left_out(FITTED, [0, 1, 2]).to_dataframe().loc["W2"]
    (check,) = (check for check in fit_of(FITTED).checks if check.of == "mode W2")
    for times, verdict in ((0.98, False), (1.02, True)):
        y = FITTED.copy()
        y[1] = row["mean"] * (1.0 + times * getattr(check, side))
        (moved,) = (check for check in fit_of(y).checks if check.of == "mode W2")
        assert moved.failed == verdict
    level = LEVEL / 2 / 3  # two kinds of checks, three modes
    assert check.above == pytest.approx(norm.isf(level / 2) * row["sd"] / row["mean"], rel=1e-3)
    assert check.shows == f"errors below {change(check.below)} or above {change(check.above)} of its frequency"


@pytest.mark.parametrize("off", [-0.5, -3.0, -4.0, -6.0, 0.5, 2.0])
def test_a_check_that_passes_excludes_no_error_that_was_found(fit_of, off):
    """A prediction with a long lower tail, a t distribution's: what was measured in it is no excluded error."""

    def skewed(y, used):
        table, sd = left_out(y, used), 0.2
        row = table.sel(mode="W2")
        mean = row["mean"].item()
        measured = mean + off * sd
        p = 2.0 * (student.sf(-off, 3) if off < 0 else norm.sf(2.0 * off))
        for name, value in {
            "measured": measured, "sd": sd, "p": p, "eti90_lb": mean + sd * student.ppf(0.05, 3),
            "eti90_ub": mean + 0.5 * sd * norm.ppf(0.95),
        }.items():  # fmt: skip
            table[name] = xr.where(table["mode"] == "W2", value, table[name])
        return table

    (check,) = (check for check in fit_of(FITTED, table=skewed).checks if check.of == "mode W2")
    mean = left_out(FITTED, [0, 1, 2])["mean"].sel(mode="W2").item()
    own = off * 0.2 / mean
    assert check.failed == (not check.below <= own <= check.above)
    assert -check.below > 1.9 * check.above


def test_a_mode_without_a_prediction_is_no_check(fit_of):
    """Its residuals may be hundreds of times as large: the model was updated with it."""
    fit = fit_of(FITTED, table=None)
    assert [check.could_fail for check in fit.checks] == [False, False, False, True]
    assert [check.kind for check in fit.able] == [RESIDUALS]
    (line,) = (reason for reason in fit.reasons if "No check of" in reason)
    assert line.startswith("No check of modes W1, W2 and T1: no prediction by the other modes was computed")
    contradicted = fit_of(FITTED + np.array([0.0, 12.0, 0.0]), table=None)
    assert contradicted.answer == f"contradicted by {len(contradicted.against)} of {len(contradicted.able)} checks"


def test_where_no_check_could_fail_the_model_is_not_testable(fit_of):
    fit = fit_of(FITTED, table=None)
    silent = replace(fit, checks=tuple(check for check in fit.checks if not check.could_fail))
    assert (silent.verdict, silent.answer) == (NOT_TESTABLE, "not testable: no check could have failed")
    assert silent.reasons[0] == "No check could have failed."


def test_data_that_the_model_cannot_reach(fit_of):
    """Without the predictions the residuals are what is left; at twice the level, for fewer kinds."""
    fit = fit_of(FITTED + np.array([0.0, 12.0, 0.0]), table=None)
    assert RESIDUALS in kinds(fit)
    assert fit.against[-1].startswith("all used data together") or "Σ r²" in fit.against[-1]


def test_the_p_value_of_the_residuals(fit_of):
    y = FITTED + np.array([0.0, 1.2, 0.0])
    (check,) = (check for check in fit_of(y).checks if check.kind == RESIDUALS)
    mean, C = posterior(y, [0, 1, 2])
    theta = np.random.default_rng(1).multivariate_normal(mean, C, 20_000)
    D = np.sum(((100.0 + theta @ SLOPES.T - y) / SD) ** 2, axis=1)
    assert check.p == pytest.approx(chi2.sf(D, 3).mean(), rel=0.1)
    larger = float(check.shows.split()[1])
    assert chi2.sf(larger**2 * D, 3).mean() == pytest.approx(LEVEL / 4, rel=0.3)


def test_no_more_data_than_parameters(fit_of):
    """Two used modes and two parameters: the mode that was held out is the test."""
    silent = fit_of(FITTED, used=(0, 1))
    assert silent.verdict == NOT_CONTRADICTED  # by the mode that was not used
    (line,) = (reason for reason in silent.reasons if "not used" in reason)
    assert line.startswith("Predicted though not used in updating: mode T1; errors below ")
    assert "2 data, 2 parameters: only what was held out tests the model." in silent.reasons
    fit = fit_of(FITTED + np.array([0.0, 0.0, 2.0]), used=(0, 1))
    assert kinds(fit) == {HELD_OUT}
    assert fit.against[0].startswith("mode T1, not used in updating: ")


@pytest.fixture
def two_modes(make_result):
    """Two modes, two parameters."""

    class Two(LinearModel):
        n_modes = 2

        def frequencies(self, theta):
            return super().frequencies(theta)[:, :2]

    def make(y):
        parameters = [fmu.Parameter(n, 0.0, prior=fmu.Normal(s)) for n, s in zip("ab", PRIOR_SD, strict=True)]
        problem = fmu.UpdatingProblem(Two(), fmu.ModalData(y, labels=("W1", "W2"), sd_hz=SD[:2]), parameters)
        draws = np.random.default_rng(4).multivariate_normal(*posterior(y, [0, 1]), DRAWS)
        trace = to_trace(make_result(draws), problem)
        trace["leave_one_out"] = xr.DataTree(left_out(np.append(y, 0.0), [0, 1]).isel(mode=slice(2)))
        return model_fit(trace)

    return make


def test_data_no_more_than_parameters_are_not_testable(two_modes):
    fit = two_modes(FITTED[:2])
    assert (fit.verdict, fit.answer) == (NOT_TESTABLE, "not testable: 2 data, 2 parameters")
    assert fit.reasons[0].startswith("There are no more data than parameters: 2 data, 2 parameters.")
    assert fit.reasons[-1].startswith("No mode was held out: `use = false`")


def test_a_failed_check_outweighs_too_many_parameters(two_modes):
    fit = two_modes(
        FITTED[:2] + np.array([0.0, 60.0])
    )  # thirty prior standard deviations, which both parameters follow
    assert fit.verdict == CONTRADICTED


@pytest.fixture
def noisy(make_result):
    """One frequency errors' size inferred: draws around `sigma`, under a prior of the given spread."""

    def make(sigma, spread, of=model_fit):
        prior = fmu.LogNormal(0.1, spread)
        noise = fmu.Parameter("sd_f", 0.1, 0.0, np.inf, prior, unit="Hz")
        parameters = [fmu.Parameter(n, 0.0, prior=fmu.Normal(s)) for n, s in zip("ab", PRIOR_SD, strict=True)]
        errors = fmu.FrequencyErrors("absolute", sd=noise)
        problem = fmu.UpdatingProblem(
            LinearModel(), fmu.ModalData(FITTED, labels=("W1", "W2", "T1")), parameters, error=errors
        )
        rng = np.random.default_rng(4)
        theta = rng.multivariate_normal(*posterior(FITTED, [0, 1, 2]), DRAWS)
        draws = np.concatenate([theta, np.exp(np.log(sigma) + 0.1 * rng.standard_normal((*DRAWS, 1)))], axis=-1)
        trace = to_trace(make_result(draws), problem)
        trace["leave_one_out"] = xr.DataTree(left_out(FITTED, [0, 1, 2]))
        return of(trace)

    return make


@pytest.mark.parametrize(("sigma", "spread", "failed"), [(0.12, 0.3, False), (0.4, 0.3, True), (0.4, 2.0, False)])
def test_noise_that_absorbs_the_misfit(noisy, sigma, spread, failed):
    """The same noise contradicts a model whose prior knew it, and one whose prior allows anything never."""
    fit = noisy(sigma, spread)
    (check,) = (check for check in fit.checks if check.kind == NOISE)
    assert check.failed == failed
    assert check.p == pytest.approx(norm.sf((np.log(sigma / 0.1)) / np.hypot(0.1, spread), scale=1.0), rel=0.2)
    if failed:
        assert fit.against[0].startswith(
            "sd_f, the inferred noise of frequencies: 0.404 ± 0.040 Hz (0.4 Hz in mode W1, 0.4 %), "
        )
        assert "the noise absorbs what the model does not explain" in fit.against[0]
    elif spread > 1.0:
        assert check.why_not == "the noise was free to grow"
        assert not check.could_fail
        assert any("The noise was free to grow: only beyond" in note for note in fit.notes)
    else:
        assert check.could_fail


@pytest.mark.parametrize(("mac", "verdict"), [(0.79, CONTRADICTED), (0.9, NOT_CONTRADICTED)])
def test_a_shape_that_no_error_model_is_of(make_result, problem, mac, verdict):
    draws = np.random.default_rng(4).multivariate_normal([0.5, 0.0], 0.01 * np.eye(2), DRAWS)
    trace = to_trace(make_result(draws), problem)
    values = np.array([np.eye(3), np.diag([0.95, mac, 0.99])])
    alike = xr.DataArray(values, dims=("state", "reference_mode", "mode"), attrs={"reference": MEASURED})
    labels = ["W1", "W2", "T1"]
    coords = {"state": ["start", "posterior mean"], "reference_mode": labels, "mode": labels}
    trace["modes"] = xr.DataTree(xr.Dataset({"mac": alike}, coords=coords))
    fit = model_fit(trace)
    failed = [check for check in fit.checks if check.kind == SHAPE and check.failed]
    assert [check.of for check in failed] == (["mode W2"] if verdict == CONTRADICTED else [])
    squares = trace["misfit"].to_dataset()
    trace["misfit"] = xr.DataTree(squares.assign_coords(quantity=["shapes"]))
    assert not [check for check in model_fit(trace).checks if check.kind == SHAPE]  # among the residuals


@pytest.mark.parametrize(("wider", "says"), [(1.05, False), (1.3, True)])
def test_a_mode_on_which_the_others_say_nothing(fit_of, wider, says):
    """They hardly narrow what the prior predicts; that is no check, but of W2, where it is little but noise."""

    def barely(y, used):
        return left_out(y, used).assign(prior_sd=left_out(y, used)["sd"] * wider)

    fit = fit_of(FITTED, table=barely)
    assert [check.could_fail for check in fit.checks] == [says, True, says, True]
    assert (
        "No check of modes W1 and T1: the other modes do not predict it any better than the prior." in fit.reasons
    ) != says


def test_nothing_to_compare(make_trace):
    trace = make_trace(np.random.default_rng(0).standard_normal((4, 50, 2)))
    fit = model_fit(trace)
    assert (fit.verdict, fit.checks) == (UNKNOWN, ())
    assert judge(trace).fit == fit


@pytest.mark.validate
def test_right_models_are_rarely_contradicted(fit_of, monkeypatch):
    """Truths from the prior, and noise as stated: by all checks together at most 1 %, with exact posteriors."""
    monkeypatch.setitem(globals(), "DRAWS", (1, 200))
    rng, told = np.random.default_rng(2026), 0
    for _ in range(RIGHT_MODELS):
        truth = PRIOR_SD * rng.standard_normal(2)
        fit = fit_of(100.0 + SLOPES @ truth + SD * rng.standard_normal(3))
        told += fit.verdict == CONTRADICTED
    assert told <= binom.isf(1e-3, RIGHT_MODELS, LEVEL)


def test_identified_deviations_far_below_the_misfit(fit_of):
    """They are told beside the verdict where the model is nearly right, and not where it fits or is far off."""
    y = FITTED + np.array([0.0, 1.0, 0.0])
    (note,) = (note for note in fit_of(y, of=judge).notes if "too small" in note)
    residuals = np.abs(100.0 + SLOPES @ posterior(y, [0, 1, 2])[0] - y)
    named = [name for name, r in zip(("W1", "W2", "T1"), residuals, strict=True) if r > 4.0 * SD[0]]
    assert note.startswith(
        f"identified deviations may be too small: mode {named[0]} (0.1 Hz, misfit 0.67 Hz or 0."
    )
    assert [name for name in ("W1", "W2", "T1") if f"mode {name} (" in note] == named
    for off in (0.3, 9.0):
        assert fit_of(FITTED + np.array([0.0, off, 0.0]), of=deviation_warnings) == []


def test_inferred_deviations_are_never_told_to_be_too_small(noisy):
    assert noisy(1e-6, 3.0, of=deviation_warnings) == []
