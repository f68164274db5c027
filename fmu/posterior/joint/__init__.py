"""Several tests of one structure, updated together: what they share, what varies, and what is known to differ.

Reading order: modal_test, population, correlation, damage, layout, joint_model, scored_prior, joint_problem,
typical.
"""
