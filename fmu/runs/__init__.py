"""Runs on disk while they go on: draws as they come, and the state of the chains, to go on from after any end."""

from __future__ import annotations

from fmu.runs.settings import Checkpoint as Checkpoint
