"""The page of the model evidences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fmu.tables import markdown_table
from tests.two_storeys import SD
from tests.validation.evidence import AGREE, CHAINS, DRAWS, IMPORTANCE_DRAWS, WARMUP, Estimate, Row


def write(
    rows: Sequence[Row], shares: Mapping[float, list[Estimate]], directory: Path, processor_s: float
) -> None:
    """Write ``evidence.md`` into the directory."""
    failures = [failure for row in rows for failure in row.failures]
    warned = sum(way.warned for row in rows for way in row.ways.values())
    verdict = f"**All methods agree within {AGREE:g} combined standard errors.**"
    if warned:
        verdict += f" {warned} estimates with a warning are not compared."
    verdict += "".join(
        f" For {row.title}, only one estimate has no warning, so nothing is compared."
        for row in rows
        if not row.is_compared
    )
    if failures:
        verdict = "**Methods that disagree:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    building, *others = rows
    beams = {(row.case, row.pairing): row for row in others if not row.region}
    regions = [row for row in others if row.region]
    first, second = (
        {pairing: best(beams[case, pairing]) for pairing in ("shape", "index")}
        for case in ("cantilever-young", "cantilever-section")
    )
    by_shape, by_number = (first[pairing] - second[pairing] for pairing in ("shape", "index"))
    one, two = (estimate.log_evidence for estimate in shares[0.01])
    at_one_percent = one - two
    (directory / "evidence.md").write_text(
        PAGE.format(
            verdict=verdict,
            minutes=processor_s / 60.0,
            chains=CHAINS,
            warmup=WARMUP,
            draws=DRAWS,
            importance=IMPORTANCE_DRAWS,
            building=_ways([building]),
            sd=SD,
            normaliser=-np.log(2.0 * np.pi * SD**2),
            published=np.exp(building.ways["quadrature"].log_evidence) * 2.0 * np.pi * SD**2,
            beams=_ways(list(beams.values())),
            fit=_fit(list(beams.values())),
            by_shape=by_shape,
            at_one_percent=at_one_percent,
            factor=np.exp(at_one_percent),
            by_number=by_number,
            favoured_by_shape=_favoured(by_shape),
            favoured_by_number=_favoured(by_number),
            errors=markdown_table(
                ["sd of the frequency errors", "five moduli", "two sections", "difference"],
                [
                    [f"{100 * share:g} %", _text(one), _text(two), f"{one.log_evidence - two.log_evidence:.2f}"]
                    for share, (one, two) in shares.items()
                ],
            ).rstrip(),
            regions=_ways(regions),
            places=_places(regions),
            behind=best(regions[0]) - best(regions[1]),
            further=best(regions[0]) - best(regions[2]),
            sum=np.logaddexp.reduce([best(row) for row in regions]),
            whole=best(beams["cantilever-section", "index"]),
            unfound=UNFOUND
            if any(way.warned for way in beams["cantilever-section", "index"].ways.values())
            else "",
        ),
        encoding="utf-8",
    )


def _favoured(difference: float) -> str:
    """Return the model with the higher log-evidence, given how far five moduli exceed two sections."""
    return "five moduli" if difference > 0.0 else "two sections"


def best(row: Row) -> float:
    """Return the estimate with the smallest error."""
    return min(row.ways.values(), key=lambda one: one.error).log_evidence


def _text(estimate: Estimate) -> str:
    decimals = 5 if estimate.error == 0.0 else 2 if estimate.error > 0.05 else 3
    mark = "⚠ " if estimate.warned else ""
    return f"{mark}{estimate.log_evidence:.{decimals}f}" + (f" ± {estimate.error:.2g}" if estimate.error else "")


def _ways(rows: Sequence[Row]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row.ways))
    cells = [
        [f"{row.case}, by {_PAIRING[row.pairing]}{row.region and ', ' + row.region}"]
        + [_text(row.ways[name]) if name in row.ways else "-" for name in names]
        + ["a bound is active" if np.isnan(row.laplace) else f"{row.laplace:.3f}"]
        for row in rows
    ]
    return markdown_table(["log-evidence", *names, "Laplace approximation"], cells).rstrip()


def _fit(rows: Sequence[Row]) -> str:
    cells = [
        [
            f"{row.case}, by {_PAIRING[row.pairing]}",
            f"{row.log_likelihood:.1f}",
            f"{best(row):.1f}",
            f"{row.log_likelihood - best(row):.1f}",
        ]
        for row in rows
    ]
    return markdown_table(
        ["model", "log-likelihood at the maximum", "log-evidence", "Occam penalty"], cells
    ).rstrip()


def _places(rows: Sequence[Row]) -> str:
    cells = [
        [row.region, *(f"{1e9 * x:.3f}" for x in row.theta[:2]), *(f"{1e4 * x:.3f}" for x in row.theta[2:])]
        for row in rows
    ]
    return markdown_table(
        ["maximum", "Ix1, 1e-9 m⁴", "Ix2, 1e-9 m⁴", "Ax1, 1e-4 m²", "Ax2, 1e-4 m²"], cells
    ).rstrip()


_PAIRING = {"shape": "shape", "index": "number"}

PAGE = """# Model evidences

Do independent methods give the same model evidence?

{verdict}

The evidence of a model is ∫ P(D|θ) P(θ) dθ, the prior predictive density of the measured data. Logarithms are
natural. The evidences of two models of the same measurement are comparable if the likelihood is normalised as a
density of the measurement and the prior is normalised over its bounds. `problem.log_likelihood` and
`problem.log_prior` are defined in this way. The methods are:

- parallel tempering (`fmu.sample(problem, fmu.Tempering())`, {chains} chains from the prior, {warmup} steps of
  warm-up and {draws} draws); `fmu.evidence` evaluates the same run by stepping-stone sampling and by thermodynamic
  integration;
- importance sampling around the maxima from `fmu.find_map`, with Gaussians truncated at the bounds ({importance}
  draws for each maximum, and as many from a Gaussian of twice the width). It is independent of tempering.

All estimates of a row are compared in pairs. Estimates with a warning from `fmu.evidence` are marked with ⚠
and are not compared. The Laplace approximation is not compared either; it is not valid if a bound is active. The
study took {minutes:.0f} minutes of processor time.

## A two-storey building with a bimodal posterior: comparison with quadrature

{building}

With `kind = "eigenvalue"` the likelihood is normalised as a density of ε = (f/f_m)² − 1. Beck & Au (2002) omit the
factor 1/(2πσ²) with σ = {sd:g}, so their evidence is exp(log-evidence − {normaliser:.4f}) = {published:.4e}.
Scripts of the ERA group (TU Munich) give 1.52e-3 for this example. Some of them use masses of 16.531 t and
16.131 t, for which the quadrature gives 1.523e-3.

## Five moduli or two sections?

Two models of the paper's beam are compared. *cantilever-young* updates five Young's moduli; *cantilever-section*
updates the second moments of area and the areas of the beam's two halves. Computed and measured modes are paired
by mode shape or by number.

{beams}

The Occam penalty is the log-likelihood at the maximum of the posterior minus the log-evidence.

{fit}

- **With modes paired by shape, the data favour {favoured_by_shape}. The strength of the preference depends on the
  assumed errors.** The Bayes factor of five moduli is exp({by_shape:.0f}) with β = 1, as in the paper, and
  exp({at_one_percent:.1f}) = {factor:.2g} with errors of 1 % of each frequency. With β = 1 the error has a
  standard deviation of 0.7 Hz for every frequency, which is 0.04 % of the highest. Misfits that are small in
  percent then have a large effect, and the model with two sections leaves more of them. With errors proportional
  to the frequency, importance sampling gives:

{errors}

- **With modes paired by number, as in the paper, the data favour {favoured_by_number}.** The Bayes factor of
  five moduli is exp({by_number:.0f}) with β = 1. The pairing matters: it compares a computed mode of the strong
  plane with a mode measured in the weak plane, and the sections can be adjusted until the two frequencies match.
  An evidence judges a model as it is specified, including a wrong pairing.

- **The bounds matter.** Priors are truncated at their bounds and normalised between them. If the data determine a
  parameter well, doubling the width of its prior lowers the log-evidence by log 2 = 0.69. Moving a bound at which
  the posterior is cut off may raise it by much more. Five parameters can thus lose 5 log 2 = 3.5; compare the
  difference of {at_one_percent:.1f} between the models with errors of 1 %.

## Two sections paired by number: three regions

If modes are paired by number, the k-th frequency belongs to different mode shapes in different regions of the box.
The regions are defined by which computed modes are paired with the measured ones. They fill the box, so their
evidences add up to the evidence of the whole box. Three regions have a relevant maximum: A, B and C. For each
region, the likelihood is set to zero outside it, and tempering starts at its maximum. The prior remains normalised
over the whole box.

{regions}

The maxima are:

{places}

The log-evidences of B and C are lower than that of A by {behind:.0f} and {further:.0f}. The three regions
together have a log-evidence of {sum:.3f}, and the whole box has {whole:.3f}. A run over the whole box cannot
estimate the evidences of B and C from shares of its draws, because only about one draw in exp({behind:.0f}) is in
B. Each region is therefore sampled separately.
{unfound}"""

UNFOUND = """
Over the whole box, tempering of this length does not converge (⚠ above). At the rungs where the likelihood has a
power of 0.1 to 0.5, chains whose replicas reached B or C have not yet found A. `fmu.evidence` warns because the
chains disagree at these rungs (R-hat). The standard error alone would not show it.
"""
