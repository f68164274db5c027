"""From a slow model to a surrogate with a certificate: which theta are solved, and when there are enough.

Reading order: learning, selection, error_limits.
"""
