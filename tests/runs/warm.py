"""Imports all that a run needs, in the process from which others are forked."""

from tests.runs.watched import sampled

sampled(None)
