"""An independence sampler whose proposal, a mixture of truncated Gaussians, is fitted to the posterior in warm-up.

Reading order: `truncated_normal`, `quadratic`, `warp`, `importance`, `proposal`, `kernel`, `mixture`; for
densities that are bent, hollow or infinite at a wall `curve`, `bent`, `curved`; then `warmup`.
"""
