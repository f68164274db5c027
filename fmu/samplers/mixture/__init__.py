"""An independence sampler whose proposal, a mixture of truncated Gaussians, is fitted to the posterior in warm-up.

Reading order: `truncated_normal`, `quadratic`, `proposal`, `kernel`, `mixture`.
"""
