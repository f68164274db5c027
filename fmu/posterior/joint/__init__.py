"""Several tests of one structure, updated together: what they share, what varies, and what is known to differ.

Reading order: modal_test, population, layout, joint_model, joint_problem.
"""
