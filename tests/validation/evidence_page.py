"""The page of the evidences."""

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
    verdict = "**All ways agree.**"
    if failures:
        verdict = "**Ways that disagree:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    building, *others = rows
    beams = {(row.case, row.pairing): row for row in others if not row.region}
    regions = [row for row in others if row.region]
    first, second = (
        {pairing: best(beams[case, pairing]) for pairing in ("shape", "index")}
        for case in ("cantilever-young", "cantilever-section")
    )
    one, two = (estimate.log_evidence for estimate in shares[0.01])
    at_one_percent = one - two
    (directory / "evidence.md").write_text(
        PAGE.format(
            verdict=verdict,
            minutes=processor_s / 60.0,
            agree=AGREE,
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
            by_shape=first["shape"] - second["shape"],
            at_one_percent=at_one_percent,
            factor=np.exp(at_one_percent),
            by_number=second["index"] - first["index"],
            errors=markdown_table(
                ["error of a frequency", "five moduli", "two sections", "difference"],
                [
                    [f"{100 * share:g} %", _text(one), _text(two), f"{one.log_evidence - two.log_evidence:.2f}"]
                    for share, (one, two) in shares.items()
                ],
            ).rstrip(),
            regions=_ways(regions),
            places=_places(regions),
            behind=best(regions[0]) - best(regions[1]),
            sum=np.logaddexp.reduce([best(row) for row in regions]),
            whole=best(beams["cantilever-section", "index"]),
            unfound=UNFOUND
            if any(way.warned for way in beams["cantilever-section", "index"].ways.values())
            else "",
        ),
        encoding="utf-8",
    )


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
    return markdown_table(["log-evidence of", *names, "Laplace"], cells).rstrip()


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
        ["", "log-likelihood at the maximum", "log-evidence", "what is lost to the prior"], cells
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

PAGE = """# Evidences

Written by `make validate` in {minutes:.0f} minutes of processor time. Every evidence is found in independent ways,
which must agree within {agree:g} combined standard errors; estimates that `fmu.evidence` itself warns of are
marked with ⚠ and take no part.

{verdict}

The evidence of a model is ∫ P(D|θ) P(θ) dθ, the probability of the measurement before anything was fitted to it.
Logarithms are natural. Two models of the same measurement can be compared where the likelihood is normalised as
a density of it, and the prior over its bounds, which is how `problem.log_likelihood` and `problem.log_prior` are
defined. The ways are:

- parallel tempering (`fmu.sample(problem, fmu.Tempering())`, {chains} chains from the prior, {warmup} steps of
  warm-up and {draws} draws), with `fmu.evidence` by stepping stones and by thermodynamic integration;
- importance sampling around the maxima that `fmu.find_map` finds, with Gaussians cut off at the bounds
  ({importance} draws from each and as many from one of twice the width), which tempering knows nothing of.

The Laplace approximation is for comparison alone: where a bound is active its Gaussian is not the posterior.

## Two storeys with two modes: against quadrature

{building}

`kind = "eigenvalue"` is normalised as a density of ε = (f/f_m)² − 1. Beck & Au (2002) leave out the normaliser
1/(2πσ²) with σ = {sd:g}: their evidence is exp(log-evidence − {normaliser:.4f}) = {published:.4e}. Scripts of the
ERA group (TU Munich) give 1.52e-3 for this example, some with masses of 16.531 t and 16.131 t; with these the
quadrature gives 1.523e-3.

## Five moduli or two sections?

{beams}

{fit}

- **By shape the data prefer five moduli, by how much depends on the errors that are assumed**: by a factor of
  exp({by_shape:.0f}) with β = 1, as in the paper, and of exp({at_one_percent:.1f}) = {factor:.0f} with errors of
  1 % of each frequency, which is little. With β = 1 an error has a standard deviation of 0.7 Hz whatever the
  frequency is, 0.04 % of the highest: misfits that are small in percent weigh heavily, and two sections leave more
  of them.
  With errors in proportion to the frequency, by importance sampling:

{errors}

- **By number, as in the paper, they prefer two sections**, with β = 1 by a factor of exp({by_number:.0f}). The
  pairing decides: by number a mode of the strong plane answers to one that was measured in the weak plane, and the
  sections can move it to where it fits. An evidence compares what one has written down, wrong pairing and all.

- **Bounds matter.** The priors are cut off at their bounds and normalised over what is left, so that doubling
  the width of a prior that the data narrow down costs log 2 = 0.69 a parameter, and opening a bound that the
  posterior presses against may gain much more. Five parameters can thus lose 3.5, more than the
  {at_one_percent:.1f} between the models with errors of 1 %: there the data do not decide between them.

## Two sections by number: three regions

The k-th frequency is that of a different mode shape in different parts of the box. These regions, told apart by
which modes answer to the measured ones, make up the box, and their evidences the whole; three of them have a
maximum worth mention. The likelihood is set to zero outside a region; tempering then starts at its maximum, and
the share of the prior outside costs its due.

{regions}

The maxima:

{places}

B is the lower by {behind:.0f}, C by more; their sum is {sum:.3f}, and the whole {whole:.3f}. A chain never finds
that out by itself: of the draws of a correct run one in exp({behind:.0f}) is in B. Shares of draws cannot tell the
evidences of B and C, which is why each is sampled for itself.
{unfound}"""

UNFOUND = """
Over the whole box tempering of this length is not done (⚠ above): where the likelihood counts for a tenth to a
half of itself, replicas that climbed to B or C have yet to find A, chain by chain. `fmu.evidence` says so, because
the chains disagree at those rungs (R-hat); its standard error alone would not.
"""
