"""Pages without their pictures, which take most of the time of a page: for what a page says in words."""

import importlib
import pkgutil
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

from markupsafe import Markup

from fmu.report import sections
from fmu.report.document import Picture

_READ = {"plot_ranks", "plot_ranks_of_samplers", "plot_autocorrelation", "plot_running_rhat"}
"""Some are drawn for what is said of them."""


@contextmanager
def without_pictures() -> Iterator[None]:
    """Leave the pictures of pages empty, but require a description of each."""

    def empty(axes, key, alt, caption, data=None):
        assert alt.strip()
        return Picture(Markup("<svg></svg>"), caption, 400)

    patches = []
    for found in pkgutil.iter_modules(sections.__path__, f"{sections.__name__}."):
        module = importlib.import_module(found.name)
        for name in vars(module).copy():
            if name.startswith(("plot_", "linked_")) and name not in _READ:
                patches.append(mock.patch.object(module, name, return_value=None))
        if hasattr(module, "picture"):
            patches.append(mock.patch.object(module, "picture", empty))
    for patch in patches:
        patch.start()
    try:
        yield
    finally:
        for patch in reversed(patches):
            patch.stop()
