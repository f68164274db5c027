"""What every sampler runs in: starts, groups of chains, warm-up, draws, and the state between them.

Reading order: settings, starts, run, group, record.
"""
