"""The certified reduced basis: trained with residuals, verified over the parameter box, and cached on disk.

Reading order: basis, space, anchors, shared, residuals, learning, cost, points, confirming, training,
reduced_structure, cache.
"""
