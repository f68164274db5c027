"""What the draws say, and whether they can be believed.

Before sampling: check, initial_modes, gradient_check, prior_prediction, identifiability, repeatability, estimate.
After it: trace, convergence, maxima; then prediction, held_out, information, fit, pairing_changes, evidence,
certificate.
"""
