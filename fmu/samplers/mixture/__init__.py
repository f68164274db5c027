"""An independence sampler whose proposals come from a mixture of truncated Gaussians fitted in warm-up.

A proposal drawn from the mixture is called a candidate. Reading order: `truncated_normal`, `quadratic`, `warp`,
`importance`, `proposal`, `kernel`, `mixture`; then `curve`, `bent` and `curved`, for densities that are curved,
hollow or infinite at a bound; then `warmup`. The module `move` contains a move for emcee's own sampler.
"""
