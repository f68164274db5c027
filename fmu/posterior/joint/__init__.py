"""Joint updating with several tests of one structure: shared and varying parameters, and known changes.

A parameter may scatter from test to test, with values drawn from a *population*. The *score* of a test is its
standardised value: a standard normal number that a population's distribution maps to the value of the parameter in
the test. All parameters of theta other than the scores are the *main parameters*.

Reading order: modal_test, varies, correlation, layout, build_layout, model_in_tests, joint_problem, typical.
"""
