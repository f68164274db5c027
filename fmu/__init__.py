"""Bayesian finite-element model updating.

Measured vibration modes and a finite-element model give a posterior distribution of the model's uncertain
parameters. Several Markov chain samplers draw from it, and diagnostics say how far each can be trusted::

    problem = fmu.cases.load("cantilever-young")
    trace = fmu.sample(problem, "hmc", draws=1000, warmup=1000, chains=4, seed=1)
    print(fmu.summary(trace))

The public names are listed in ``__init__.pyi``. Each is imported when it is first used, so ``import fmu`` is fast.
"""

import lazy_loader

_public, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ = sorted((*__all__, "__version__"))


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "__version__":
        from importlib.metadata import version

        return version("fmu")
    return _public(name)


def __dir__() -> list[str]:
    """Return the list of public names, whether imported or not."""
    return list(__all__)
