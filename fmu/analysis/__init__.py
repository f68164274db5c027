"""What the draws say, and whether they can be believed.

Before sampling: start, identifiability, uninformed, repeatability, estimate.
After it: trace, convergence, maxima; then prediction, held_out, information, fit, pairing_changes, evidence,
certificate.
"""
