"""Joint updating with several tests of one structure: shared and varying parameters, and known changes.

Reading order: modal_test, varies, correlation, layout, build_layout, model_in_tests, joint_problem, typical.
"""
