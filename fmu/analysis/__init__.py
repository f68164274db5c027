"""Analysis before and after sampling: what the data determine, what the draws show, and whether they are reliable.

Modules used before sampling: start, identifiability, uninformed, repeatability, estimate, plan.
Modules used after sampling: trace, convergence, maxima; then prediction, held_out, information, fit, frf, models,
next_test, pairing_changes, evidence (with evidence_estimators), certificate.
Modules of both groups use uninformed, repeatability and permutation.
"""
