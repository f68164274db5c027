"""Several tests of one structure, updated together: shared parameters, varying ones, and known differences.

Reading order: modal_test, population, correlation, damage, layout, joint_model, scored_prior, joint_problem,
typical.
"""
