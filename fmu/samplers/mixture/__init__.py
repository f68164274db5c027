"""An independence sampler that draws candidates from a mixture of truncated Gaussians, fitted in warm-up.

Reading order: `truncated_normal`, `quadratic`, `warp`, `importance`, `proposal`, `kernel`, `mixture`; then
`curve`, `bent` and `curved`, for densities that are bent, hollow or infinite at a wall; then `warmup`.
"""
