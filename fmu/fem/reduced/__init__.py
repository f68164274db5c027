"""The certified reduced basis: trained by residuals, tested over the box of parameters, and cached on disk.

Reading order: basis, space, anchors, shared, residuals, learning, cost, points, confirming, training,
reduced_structure, cache.
"""
