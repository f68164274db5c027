"""Sections: their numbers are those of the analysis, in the units that people read."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from fmu.analysis.convergence.diagnosis import UNSEARCHED
from fmu.analysis.held_out.modes import leave_one_out
from fmu.analysis.identifiability import kept_identifiability
from fmu.analysis.information import CRITERION, information, left_along
from fmu.analysis.prediction import at_bounds
from fmu.analysis.trace.modal_states import MEASURED
from fmu.fem.pairing.correlation import ALIKE
from fmu.report.document import Details, Items, Link, Omitted, PageTable, Text
from fmu.report.run import runs_of
from fmu.report.sections import chains, comparison, origin, prediction, structure, updating
from fmu.report.sections.fit import model_fit
from fmu.report.sections.information import sensitivity
from fmu.report.sections.verdicts import COVERED, SOUND, convergence, judge_data, verdicts


@pytest.fixture(scope="module")
def runs(beam_traces):
    return runs_of(beam_traces)


@pytest.fixture(scope="module")
def hmc(runs):
    return runs["hmc"]


def table(section, caption=""):
    """Return the rows of a section's table as dicts."""
    found = next(part for part in section.parts if isinstance(part, PageTable) and caption in part.caption)
    return [dict(zip(found.header, row, strict=True)) for row in found.rows]


def number(text):
    return float(text.replace("−", "-").replace("%", "").replace(" ", ""))


def shows(text, value):
    """Whether a text is the value, rounded to as many decimals as it has."""
    half_unit = 0.5 * 10.0 ** -len(text.partition(".")[2])
    return abs(number(text) - value) <= 1.001 * half_unit


def test_parameters(hmc):
    tables = [part for part in updating.parameters(hmc).parts if isinstance(part, PageTable)]
    rows = {row[0]: dict(zip(part.header, row, strict=True)) for part in tables for row in part.rows}
    for name, expected in hmc.summary.iterrows():
        row = rows.pop(name)
        assert row["unit"] == "GPa"
        assert number(row["sd"]) == pytest.approx(expected["sd"] / 1e9, rel=0.05)
        low, high = row["90 % interval"].split(" to ")
        for text, column in ((row["mean"], "mean"), (low, "eti90_lb"), (high, "eti90_ub")):
            assert shows(text, expected[column] / 1e9)
        assert number(row["start"]) == 240.0
        if "change" in row:  # not of a parameter that the data did not update
            assert number(row["change"]) == pytest.approx(100 * (expected["mean"] / 2.4e11 - 1), abs=0.06)
        assert list(map(number, row["bounds"].split(" to "))) == [170.0, 250.0]
    assert rows == {}


def test_errors_of_the_ends_of_the_intervals(hmc):
    rows = {row["parameter"]: row for row in table(chains.reliability(hmc))}
    for name, expected in hmc.summary.iterrows():
        assert shows(rows[name]["MCSE of the 5 % end"], expected["mcse_eti90_lb"] / 1e9)
        assert shows(rows[name]["MCSE of the 95 % end"], expected["mcse_eti90_ub"] / 1e9)
    (shown,) = (part for part in updating.parameters(hmc).parts if isinstance(part, PageTable))
    ends = hmc.summary[["mcse_eti90_lb", "mcse_eti90_ub"]].max(axis=1) / hmc.summary["sd"]
    largest = f"a Monte Carlo error of at most {ends.max():.2g} sd ({ends.idxmax()})"
    assert largest in shown.caption


def test_frequencies(hmc):
    before = hmc.trace["modes"]["frequency"].sel(state="start").to_numpy()
    rows = table(updating.frequencies(hmc))
    for row, f, (_, expected) in zip(rows, before, hmc.prediction.iterrows(), strict=True):
        assert number(row["measured, Hz"]) == expected["measured"]
        assert number(row["before, Hz"]) == pytest.approx(f, abs=0.06)
        assert number(row["after, Hz"]) == pytest.approx(expected["mean"], abs=0.06)
        for column, value in (("error before", f), ("error after", expected["mean"])):
            assert number(row[column]) == pytest.approx(100 * (value / expected["measured"] - 1), abs=0.06)
        narrow = list(map(number, row["90 %, without noise, Hz"].split(" to ")))
        wide = list(map(number, row["90 %, with noise, Hz"].split(" to ")))
        assert narrow == pytest.approx([expected["eti90_lb"], expected["eti90_ub"]], abs=0.06)
        assert wide == pytest.approx([expected["noisy_eti90_lb"], expected["noisy_eti90_ub"]], abs=0.06)


def test_maxima(hmc):
    section, best = updating.maxima(hmc), hmc.maxima[0]
    rows = {row["quantity"]: row for row in table(section)}
    assert number(rows["log-probability"]["maximum 1"]) == pytest.approx(best.log_prob, abs=0.06)
    assert section.parts[-1].items == (f"Maximum 1 lies at bounds: {hmc.maxima.words_at_bounds(best)}.",)
    assert shows(rows["E2"]["maximum 1"], best.theta[1] / 1e9)
    assert number(rows["mode 4"]["maximum 1"]) == pytest.approx(best.frequencies[3], abs=0.06)
    assert number(rows["mode 4"]["measured"]) == 1082.2


def test_identifiability(hmc):
    """What the draws say comes first; the linearised model stands beside it, along its own directions."""
    section = structure.identifiability(hmc)
    found, kept = information(hmc.trace), kept_identifiability(hmc.trace)
    (said,) = (part.items for part in section.parts if isinstance(part, Items))
    assert said[: len(found.sentences())] == tuple(found.sentences())
    assert said[len(found.sentences())].startswith("The model linearised at the highest maximum ")
    assert Text(CRITERION) in section.parts
    (details,) = (part for part in section.parts if isinstance(part, Details))
    drawn, start, maximum = details.parts
    assert drawn.header[:3] == ("direction", "sd left", "contraction")
    assert [number(row[1]) for row in drawn.rows] == pytest.approx(found.remaining_sd, rel=0.01)
    for state, part in (("start", start), ("maximum", maximum)):
        assert part.header[:4] == ("direction", "singular value", "sd left", "sd left, draws")
        s = kept[state].singular_values
        assert [number(row[1]) for row in part.rows] == pytest.approx(s, rel=0.01)
        assert [number(row[2]) for row in part.rows] == pytest.approx(1 / np.hypot(1, s), rel=0.01)
        assert [number(row[3]) for row in part.rows] == pytest.approx(left_along(hmc.trace, kept[state]), rel=0.01)
    for k, row in enumerate(table(section, "From prior to posterior")):
        assert number(row["contraction"]) == pytest.approx(found.contraction[k], abs=6e-3)
        prior_sd = float(hmc.trace["prior"][row["parameter"]].std(ddof=1)) / 1e9
        assert number(row["prior sd"]) == pytest.approx(prior_sd, abs=0.6)


def test_shapes_and_mac(hmc):
    section = structure.mac(hmc)
    assert section.title == "MAC with the model's modes before updating"
    rows = table(structure.shapes(hmc))
    modes = hmc.trace["modes"].to_dataset()
    one, other = (modes.sel(state=state) for state in ("start", "posterior mean"))
    for k, row in enumerate(rows):
        assert number(row["after, Hz"]) == pytest.approx(float(other["frequency"][k]), abs=0.06)
        change = np.abs(one["displacement"][k] - other["displacement"][k]).max()
        assert number(row["change of shape"]) == pytest.approx(100 * float(change), rel=0.06)


def test_shapes_beside_measured_ones(hmc):
    trace = hmc.trace.copy()
    modes = trace["modes"].to_dataset()
    modes["mac"] = modes["mac"].assign_attrs(reference=MEASURED)
    trace["modes"] = xr.DataTree(modes)
    run = replace(hmc, trace=trace)
    assert structure.mac(run).title == "MAC with the measured shapes"
    rows = table(structure.mac(run))
    before, after = (modes["mac"].sel(state=state).to_numpy() for state in ("start", "posterior mean"))
    assert [number(row["MAC before"]) for row in rows] == pytest.approx(np.diag(before), abs=6e-3)
    assert [number(row["MAC after"]) for row in rows] == pytest.approx(np.diag(after), abs=6e-3)
    others = np.where(np.eye(len(after), dtype=bool), 0.0, after).max(axis=1)
    assert [number(row["of another mode"]) for row in rows] == pytest.approx(others, abs=6e-3)
    assert np.diag(after).min() >= ALIKE
    least = f"Every mode matches its measured shape: MAC at least {np.diag(after).min():.2f}."
    assert least in model_fit(run).notes
    assert not any("measured shape" in note for note in model_fit(hmc).notes)


def test_predictive_check(hmc):
    section = prediction.predictive(hmc)
    replicate = hmc.trace["posterior_predictive"]["frequency"]
    rows = table(section)
    for k, row in enumerate(rows):
        below = float((replicate[..., k] < hmc.prediction["measured"].iloc[k]).mean())
        assert number(row["share predicted below"]) == pytest.approx(below, abs=6e-4)
        assert row["in the 90 % interval"] == ("yes" if 0.05 <= below <= 0.95 else "no")
    inside = sum(row["in the 90 % interval"] == "yes" for row in rows)
    assert section.parts[0].words.startswith(f"{inside} of 5 measured frequencies lie in the 90 % interval")


def test_each_mode_is_predicted_by_the_others(hmc):
    expected = leave_one_out(hmc.trace)
    section = prediction.left_out(hmc)
    rows = table(section)
    assert [row["mode"] for row in rows] == list(expected.index)
    for row, (_, exact) in zip(rows, expected.iterrows(), strict=True):
        assert row["how"] == prediction.HOW[exact["method"]]
        if exact["method"]:
            value, error = row["elpd, nats"].split(" ± ")
            assert number(value) == pytest.approx(exact["elpd"], abs=0.6 * 10.0 ** -len(value.partition(".")[2]))
            assert number(error) == pytest.approx(exact["mcse_elpd"], rel=0.5)
        else:
            assert {row[key] for key in ("predicted, 90 %, Hz", "p", "elpd, nats")} == {"–"}
            assert exact[["mean", "p", "elpd"]].isna().all()


def test_modes_not_used_are_marked(hmc):
    trace = hmc.trace.copy()
    used = np.array([True, True, True, True, False])
    trace["observed_data"] = xr.DataTree(trace["observed_data"].to_dataset().assign(used=("mode", used)))
    (run,) = runs_of({"hmc": trace}).values()
    label = f"{trace['observed_data']['mode'].to_numpy()[4]} (not used)"
    for section in (updating.frequencies(run), prediction.predictive(run), prediction.left_out(run)):
        assert table(section)[4]["mode"] == label
    assert "used in updating" in prediction.predictive(run).parts[0].words
    assert "1 lie in it" in prediction.predictive(run).parts[0].words


def test_cost_counts_the_warm_up(hmc):
    section = origin.cost(hmc)
    attrs = hmc.trace.attrs
    solves = table(section)[0]
    assert number(solves["warm-up"]) == attrs["warmup_n_solves"]
    assert number(solves["both"]) == attrs["n_solves"] + attrs["warmup_n_solves"] == hmc.costs["n_solves"]
    gained = {row["quantity"]: row["value"] for row in table(section, "Efficiency")}
    assert number(gained["effective draws per 1000 solves"]) == pytest.approx(
        1000 * hmc.costs["ess_per_solve"], rel=0.006
    )


def test_certificate_is_held_against_what_was_promised(hmc):
    kept = origin.certificate(hmc)
    assert kept.parts[0].words.endswith("Reduced-model error within tolerance.")
    broken = hmc.trace.copy()
    broken.attrs = {**hmc.trace.attrs, "certificate_log_prob_error": 0.5}
    (run,) = runs_of({"hmc": broken}).values()
    section = origin.certificate(run)
    assert section.parts[0].words.endswith("Reduced-model error outside its tolerance.")
    assert table(section)[4]["found"] == "0.5"
    assert [row["allowed"] for row in table(section)[:5]] == ["1e-6", "1e-6", "0", "1e-6", "0.001"]
    broken.attrs = {**hmc.trace.attrs, "certificate_bound_exceeded": 1}
    (run,) = runs_of({"hmc": broken}).values()
    said = "Reduced-model error above its bound, but within its tolerance."
    assert origin.certificate(run).parts[0].words.endswith(said)


def test_certificate_is_held_against_a_looser_promise(hmc):
    loose = hmc.trace.copy()
    loose.attrs = {
        **hmc.trace.attrs,
        "certificate_frequency_error": 5e-4,
        "certificate_log_prob_error": 0.05,
        "certificate_frequency_tolerance": 1e-3,
        "certificate_log_prob_tolerance": 0.1,
    }
    (run,) = runs_of({"hmc": loose}).values()
    section = origin.certificate(run)
    assert section.parts[0].words.endswith("Reduced-model error within tolerance.")
    assert [row["allowed"] for row in table(section)[3:5]] == ["0.001", "0.1"]


def test_settings_show_what_was_learnt_and_where_it_comes_from(hmc):
    section = origin.settings(hmc)
    rows = {row["setting"]: row for row in table(section)}
    assert rows["step size"]["given"] == "–"
    assert number(rows["step size"]["after warm-up"]) > 0
    assert rows["inverse mass"]["after warm-up"] == "5 × 5 matrix"
    about = {row["quantity"]: row["value"] for row in table(section, "The run")}
    assert about["seed"] == "1"
    assert about["configuration hash (SHA-256)"] == hmc.trace.attrs["configuration_hash"]
    assert about["version of fmu"]


def test_energies_are_of_hamiltonian_trajectories_only(runs):
    assert "E-BFMI of the chains" in chains.energies(runs["hmc"]).parts[0].words
    assert isinstance(chains.energies(runs["emcee"]), Omitted)


def test_samplers_side_by_side_lead_to_their_pages(runs):
    found = comparison.Compared.of(runs)
    section = comparison.costs(found, {"hmc": "hmc.html", "emcee": "emcee.html"})
    rows = table(section)
    assert [row["sampler"] for row in rows] == [
        Link("Hamiltonian Monte Carlo", "hmc.html"), Link("emcee ensemble, the baseline", "emcee.html")
    ]  # fmt: skip
    assert number(rows[0]["whole run"]) == pytest.approx(found.costs.loc["hmc", "total_solves"], rel=0.01)
    assert rows[1]["/ emcee"] in ("1.00 ×", "–")  # the latter where it did not meet the criterion
    assert section.parts[-1].words.startswith("emcee ")


@pytest.mark.parametrize(("shift", "answer"), [(0.0, "Yes"), (1.0, "No")])
def test_samplers_agree_or_one_is_wrong(shift, answer, plain_traces):
    good = plain_traces["hmc"]
    other = good.copy()
    other["posterior"] = other["posterior"].to_dataset() + shift
    agree, *_ = comparison.verdicts_on_samplers(comparison.Compared.of(runs_of({"one": good, "two": other})))
    assert (agree.answer, agree.is_good) == (answer, answer == "Yes")
    assert "one and two" in agree.said


def test_the_page_judges_scores_of_tests_as_the_verdict_does(hmc):
    summary = hmc.summary.assign(rhat=1.001, ess_bulk=900.0, ess_tail=900.0)
    summary.loc["E2", ["rhat", "ess_bulk"]] = 1.03, 50.0
    summary.attrs["scores"] = ["E2"]
    run = replace(hmc, summary=summary)
    assert convergence(run).said.startswith("R-hat at most 1.0010 (below 1.01 needed), at least 900 effective")
    said = chains.paths(run).parts[0].words
    assert said == "The chains agree: the worst R-hat is 1.0300, in E2; below 1.05 is needed."


def test_samplers_with_too_few_draws_are_not_compared(plain_traces):
    found = comparison.Compared.of(runs_of(plain_traces))
    agree, trust, cost = comparison.verdicts_on_samplers(found)
    assert (agree.answer, agree.is_good) == ("Not known", None)
    assert "whose R-hat or effective draws miss the criterion" in agree.said
    assert trust.reasons[0].split(":")[0] not in ("Hamiltonian Monte Carlo",)
    assert cost.answer.startswith("hmc ")


def test_columns_of_cosine_above_095_are_separated_where_they_differ(hmc):
    """E1 and E5 change the frequencies in one pattern, by 48 measurement sd each, and differ by 7."""
    found = kept_identifiability(hmc.trace)["maximum"]
    E1, E5 = found.sensitivity[:, 0], found.sensitivity[:, 4]
    assert abs(E1 @ E5) / np.linalg.norm(E1) / np.linalg.norm(E5) > 0.98
    assert np.linalg.norm(E1 - E5) == pytest.approx(6.9, abs=0.2)
    said, _ = sensitivity(hmc, found)
    assert said.words.startswith(
        "Every parameter affects at least one mode noticeably. Hardest to separate: E2 and E4."
    )
    assert "cannot" not in said.words
    assert judge_data(hmc).answer == "Yes, beyond the bounds: E5"  # where most of its draws lie


def test_a_good_verdict_says_what_it_covers(plain_traces):
    (run,) = runs_of({"hmc": plain_traces["hmc"]}).values()
    assert convergence(run).reasons == (SOUND, "64 starts from the prior led to 1 maximum")
    of_model = replace(run, diagnosis=replace(run.diagnosis, search=""))
    assert convergence(of_model).reasons == (SOUND, COVERED)
    (unknown,) = runs_of({"hmc": plain_traces["hmc"].filter(lambda node: node.name != "maxima")}).values()
    said = convergence(unknown)
    assert (said.answer, said.is_good) == ("Converged locally", None)
    assert said.reasons == (SOUND, UNSEARCHED)
    assert updating.maxima(unknown).reason.startswith("the trace has none")


def test_the_first_screen_has_the_numbers_of_the_tables(hmc):
    """Five lines: the largest changes, the same parameters' deviations, what is open, the fit, the run."""
    changes, sure, _, fit, trust = verdicts(hmc)
    by_change = (hmc.summary["mean"] / 2.4e11 - 1.0).sort_values(key=np.abs, ascending=False)
    for k, (name, change) in enumerate(by_change[:3].items()):
        told, value = changes.answer.split(", ")[k], sure.answer.split(", ")[k]
        assert told.startswith(f"{name} ")
        assert number(told.removeprefix(f"{name} ")) == pytest.approx(100 * change, abs=0.06)
        mean, sd = value.removeprefix(f"{name} ").removesuffix(" GPa").split(" ± ")
        assert shows(mean, hmc.summary["mean"][name] / 1e9)
        assert shows(sd, hmc.summary["sd"][name] / 1e9)
    error = hmc.prediction["mean"] / hmc.prediction["measured"] - 1.0
    k = int(np.argmax(np.abs(error)))
    assert f"{100 * error.iloc[k]:+.2f} % after (mode {k + 1})" in changes.said.replace("−", "-")
    assert ("at the bounds" in sure.said) == bool(at_bounds(hmc.trace))
    assert fit == model_fit(hmc)
    assert f"R-hat at most {hmc.summary['rhat'].max():.4f}" in trust.said
    assert [one.tone for one in (changes, sure)] == ["fact", "fact"]


def test_what_the_data_leave_to_the_prior_has_not_changed(plain_traces):
    changes, sure, told, *_ = verdicts(runs_of({"hmc": plain_traces["hmc"]})["hmc"])
    assert (changes.answer, changes.said) == ("Nothing that the data determine", "")
    assert sure.answer == "The priors alone decide"
    assert (told.answer, told.is_good) == ("x0, x1", False)


def test_fit_cannot_be_said_without_a_prediction(plain_traces, hostile_traces):
    (plain,) = runs_of({"hmc": plain_traces["hmc"]}).values()
    assert (model_fit(plain).is_good, model_fit(plain).answer) == (None, "Unknown")
    (fitted,) = runs_of({"hmc": hostile_traces["hmc"]}).values()
    assert (model_fit(fitted).is_good, model_fit(fitted).answer) == (True, "Not contradicted")


def test_pairs_are_those_of_the_strongest_correlations(hmc):
    """The two of the caption are among those drawn, and the text names the others."""
    text, drawn = chains.pairs(hmc, most=2).parts
    draws = np.stack([hmc.trace["posterior"][name].to_numpy().ravel() for name in hmc.names])
    correlation = np.abs(np.corrcoef(draws)) - np.eye(len(draws))
    i, j = sorted(np.unravel_index(np.argmax(correlation), correlation.shape))
    assert f"of {hmc.names[i]} and {hmc.names[j]}" in drawn.caption
    left = [name for name in hmc.names if name not in (hmc.names[i], hmc.names[j])]
    assert text.words.endswith(f"Left out: {', '.join(left)}.")
