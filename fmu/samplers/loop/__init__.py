"""The sampling loop of all samplers: starts, groups of chains, warm-up and draws.

Reading order: starts, group, record, run.
"""
