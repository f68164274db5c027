"""The paper repeated: both experiments, every sampler, tables and figures beside the published ones."""

from __future__ import annotations

from fmu.paper.run import run_paper

__all__ = ["run_paper"]
