"""Markov chain samplers of a log-density, independent of the finite-element model.

Reading order: kernel, local, metropolis, slice, trajectory, hmc, ensemble, adaptation, mixture/, tempering/,
gibbs/, loop/; `registry` lists the samplers by name. The public names are listed in ``__init__.pyi``; each is
imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
