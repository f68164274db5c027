"""The certified reduced basis: trained by residuals, tested over the box, cached on disk.

Reading order: basis, space, anchors, residuals, learning, cost, training, cache.
"""
