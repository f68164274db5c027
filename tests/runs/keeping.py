"""Have something happen while groups of a run are being kept."""

import itertools

from fmu.runs.store import Store


def at_keep(patch, count, happen, again=False):
    """Call `happen` after the `count`-th group is kept; with `again`, after every so many."""
    keep, kept = Store.keep, itertools.count(1)

    def keeping(store, group, unkept):
        keep(store, group, unkept)
        n = next(kept)
        if n == count or (again and n % count == 0):
            happen()

    patch.setattr(Store, "keep", keeping)
