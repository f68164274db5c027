"""The no-U-turn sampler of NumPyro and of nutpie, in unbounded coordinates, as the libraries use it."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import nutpie
from numpyro.infer import MCMC, NUTS
from nutpie.compiled_pyfunc import from_pyfunc

from fmu.posterior.reduction.region import plausible_points
from fmu.types import FloatArray
from tests.benchmarks.peers.jax_model import in_jax
from tests.benchmarks.peers.posteriors import Target, disagreement
from tests.benchmarks.peers.run import Meter, Run

CHAINS = 4
_SAME = 1e-2
"""Largest difference of the log-probabilities in JAX and of fmu at plausible points, apart from a constant."""


def numpyro_nuts(target: Target, dense: bool, warmup: int, draws: int, seed: int) -> Run:
    """Run NumPyro's NUTS on the same model in JAX. The compilation is done before, and is not counted.

    The chains are vectorized, which was measured to be faster on one core than one chain after the other. `dense`
    asks for a dense mass matrix; the default of NumPyro is a diagonal one.
    """
    mcmc, cost = _compiled(target, dense, warmup, draws)
    meter = Meter(target)
    start = jnp.asarray(target.to_free(target.starts(seed, CHAINS)))
    keys = jax.random.split(jax.random.PRNGKey(seed))
    fields = ("num_steps", "diverging")
    mcmc.warmup(keys[0], init_params={"x": start}, extra_fields=fields, collect_warmup=True)
    meter.evaluations = cost * int(mcmc.get_extra_fields()["num_steps"].sum())
    warmed = meter.read()
    mcmc.run(keys[1], extra_fields=fields)
    x = np.asarray(mcmc.get_samples(group_by_chain=True)["x"])
    meter.evaluations = cost * int(mcmc.get_extra_fields()["num_steps"].sum())
    return Run.of_chains(target.from_unit(x), warmup=warmed, draws=meter.read())


@cache
def _compiled(target: Target, dense: bool, warmup: int, draws: int) -> tuple[Any, float]:
    posterior = in_jax(target)
    theta = plausible_points(target.problem, 20, np.random.default_rng(7))
    difference = disagreement(target, posterior.at, theta)
    if not difference < _SAME:
        raise ValueError(f"{target.title}: log-probabilities must agree within {_SAME} (differ by {difference})")

    def model() -> None:
        x = numpyro.sample("x", posterior.prior)
        numpyro.factor("likelihood", posterior.log_likelihood(x))

    mcmc = MCMC(
        NUTS(model, dense_mass=dense),
        num_warmup=warmup,
        num_samples=draws,
        num_chains=CHAINS,
        chain_method="vectorized",
        progress_bar=False,
    )
    start = jnp.asarray(target.to_free(target.starts(0, CHAINS)))
    keys = jax.random.split(jax.random.PRNGKey(0))
    mcmc.warmup(keys[0], init_params={"x": start}, extra_fields=("num_steps", "diverging"), collect_warmup=True)
    mcmc.run(keys[1], extra_fields=("num_steps", "diverging"))
    return mcmc, posterior.gradient_cost(CHAINS)


def nutpie_nuts(target: Target, adaptation: str, warmup: int, draws: int, seed: int) -> Run:
    """Run nutpie's NUTS on fmu's own log-probability and exact gradient.

    nutpie runs one chain after the other, each with its warm-up. The cost is divided between warm-up and draws in
    proportion to the number of gradients.
    """
    ndim = target.problem.ndim
    starts = iter(target.to_free(target.starts(seed, CHAINS)))
    calls = [0]

    def density(z: FloatArray) -> tuple[float, FloatArray]:
        calls[0] += 1
        return target.free_log_prob_and_grad(z)

    model = from_pyfunc(
        ndim,
        lambda: lambda z, **_: density(z),
        lambda *_: lambda z, **_: {"theta": target.from_free(np.asarray(z))},
        [np.dtype("float64")],
        [(ndim,)],
        ["theta"],
        make_initial_point_fn=lambda _: next(starts),
    )
    meter = Meter(target)
    with meter.counting():
        trace = nutpie.sample(
            model, draws=draws, tune=warmup, chains=CHAINS, cores=1, seed=seed, progress_bar=False,
            adaptation=adaptation,
        )  # fmt: skip
        total = meter.read()
    kept = int(trace["sample_stats"]["n_steps"].sum()) / calls[0]
    position = trace["posterior"]["theta"].to_numpy()
    return Run.of_chains(position, warmup=total.share(1.0 - kept), draws=total.share(kept))
