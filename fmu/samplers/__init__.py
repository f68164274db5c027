"""Markov-chain samplers, which see a log-density and nothing of finite elements.

Reading order: kernel, local, metropolis, slice, trajectory, hmc, ensemble, adaptation, tempering/, loop/;
`registry` has the samplers by name. The public names are listed in ``__init__.pyi``; each is imported when it is
first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
