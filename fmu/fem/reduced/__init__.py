"""The certified reduced basis: built from snapshots, tested over the box, cached on disk.

Reading order: basis, training, cache.
"""
