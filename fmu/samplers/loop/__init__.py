"""What every sampler runs in: starts, groups of chains, warm-up and draws.

Reading order: starts, group, record, run.
"""
