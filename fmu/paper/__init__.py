"""Replication of the paper (`fmu.paper.published`): both experiments with the samplers of `fmu compare`.

Reading order: published, plan, experiment, convergence, studies/, findings, page, summary, errata, run.
"""

from __future__ import annotations

from fmu.paper.run import run_paper

__all__ = ["run_paper"]
