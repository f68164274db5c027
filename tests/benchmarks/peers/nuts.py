"""The no-U-turn sampler of NumPyro and of nutpie: in coordinates without bounds, as their libraries treat them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import nutpie
from numpyro.infer import MCMC, NUTS
from nutpie.compiled_pyfunc import from_pyfunc

from tests.benchmarks.peers.jax_model import JaxPosterior
from tests.benchmarks.peers.outcome import Counted, Length, Outcome, Stopwatch, per_call
from tests.benchmarks.peers.target import Target

CHAINS = 4


def numpyro_nuts(posterior: JaxPosterior, length: Length, dense: bool = False) -> Callable[[int], Outcome]:
    """Return what runs NumPyro's NUTS for a seed; compiled beforehand, so that no run pays for it.

    Its chains are vectorized: on one core that was measured to be faster than one chain after the other. `dense`
    asks for a dense mass matrix; the default of NumPyro is a diagonal one.
    """

    def model() -> None:
        x = numpyro.sample("x", posterior.prior)
        numpyro.factor("likelihood", posterior.log_likelihood(x))

    mcmc = MCMC(
        NUTS(model, dense_mass=dense),
        num_warmup=length.warmup,
        num_samples=length.draws,
        num_chains=CHAINS,
        chain_method="vectorized",
        progress_bar=False,
    )

    def once(seed: int) -> Outcome:
        start = jnp.asarray(posterior.target.to_free(posterior.target.starts(seed, CHAINS)))
        keys = jax.random.split(jax.random.PRNGKey(seed))
        stopwatch = Stopwatch()
        mcmc.warmup(
            keys[0],
            init_params={"x": start},
            extra_fields=("num_steps",),
            collect_warmup=True,
        )
        n_warmup = int(mcmc.get_extra_fields()["num_steps"].sum())
        warmed = stopwatch.read(n_warmup)
        mcmc.run(keys[1], extra_fields=("num_steps", "diverging"))
        x = np.asarray(mcmc.get_samples(group_by_chain=True)["x"])
        extra = mcmc.get_extra_fields()
        drawn = stopwatch.read(int(extra["num_steps"].sum()))
        return Outcome(posterior.target.from_unit(x), warmed, drawn, divergences=int(extra["diverging"].sum()))

    once(0)
    return once


def numpyro_full(
    posterior: JaxPosterior, run: Callable[[int], Outcome], points: int = 20
) -> Callable[[int], Outcome]:
    """Return NumPyro's NUTS on the full model.

    Its steps are those on the reduced model, the same posterior, and their time is that of the full model's
    gradient by itself, timed at draws from the prior: what the sampler takes besides is left out.
    """
    gradient = jax.value_and_grad(posterior.log_prob)
    at_all = jax.jit(lambda x: jax.lax.map(gradient, x))
    x = jnp.asarray(posterior.target.to_unit(posterior.target.starts(0, points)))
    seconds = per_call(lambda: jax.block_until_ready(at_all(x))) / points
    return lambda seed: run(seed).at(seconds)


def nutpie_nuts(target: Target, length: Length) -> Callable[[int], Outcome]:
    """Return what runs nutpie's NUTS for a seed, on fmu's own log-probability and exact gradient.

    nutpie runs one chain after the other, each with its warm-up. The time is divided between warm-up and draws by
    the number of gradients, which is where it goes.
    """
    ndim = target.problem.ndim

    def once(seed: int) -> Outcome:
        density = Counted(target.free_log_prob_and_grad)
        starts = iter(target.to_free(target.starts(seed, CHAINS)))
        model = from_pyfunc(
            ndim,
            lambda: lambda z, **_: density(z),
            lambda *_: lambda z, **_: {"theta": target.from_free(np.asarray(z))},
            [np.dtype("float64")],
            [(ndim,)],
            ["theta"],
            make_initial_point_fn=lambda _: next(starts),
        )
        stopwatch = Stopwatch()
        trace = nutpie.sample(
            model,
            draws=length.draws,
            tune=length.warmup,
            chains=CHAINS,
            cores=1,
            seed=seed,
            progress_bar=False,
        )
        total = stopwatch.read(density.calls)
        stats = trace["sample_stats"]
        kept = int(stats["n_steps"].sum())
        share = kept / density.calls
        return Outcome(
            trace["posterior"]["theta"].to_numpy(),
            warmup=total.share(1.0 - share),
            draws=total.share(share),
            divergences=int(stats["diverging"].sum()),
        )

    return once
