"""Several tests of one structure, updated together: shared parameters, varying ones, and known differences.

Reading order: modal_test, varies, correlation, layout, build_layout, model_in_tests, joint_problem, typical.
"""
