"""The sampling loop that all samplers share: starting points, groups of chains, warm-up and draws.

Reading order: starts, record, group, saving, run.
"""
