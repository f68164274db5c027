"""Analysis before and after sampling: what the data determine, what the draws show, and whether they are reliable.

Before sampling: start, identifiability, uninformed, repeatability, estimate.
After sampling: trace, convergence, maxima; then prediction, held_out, information, fit, pairing_changes, evidence,
certificate.
"""
