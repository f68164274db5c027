"""The paper repeated: both experiments, every sampler, tables and figures beside the published ones.

Reading order: published, plan, experiment, convergence, findings, page, summary, errata, vector_beta, run.
"""

from __future__ import annotations

from fmu.paper.run import run_paper

__all__ = ["run_paper"]
