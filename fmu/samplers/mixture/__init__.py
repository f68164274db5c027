"""An independence sampler whose proposal, a mixture of truncated Gaussians, is fitted to the posterior in warm-up.

Reading order: `truncated_normal`, `quadratic`, `warp`, `importance`, `proposal`, `kernel`, `mixture`; then
`curve`, `bent` and `curved`, for densities that are bent, hollow or infinite at a wall; then `warmup`.
"""
