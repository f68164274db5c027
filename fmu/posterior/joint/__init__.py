"""Joint updating with several tests of one structure.

A parameter may be shared by the tests, may vary between them, or may have a known value in some of them. A
parameter may also scatter from test to test, with values drawn from a *population*. A test's *score* is a number
that the population's distribution maps to the parameter value in that test. Unless it is centred
(`fmu.posterior.joint.varies.drawn`), it is the standardised value, which is standard normal a priori. All
parameters in theta other than the scores are the *main parameters*.

Reading order: modal_test, varies, correlation, outliers, layout, build_layout, model_in_tests, configurations,
quantities, joint_problem; then conditional, blocks, typical, for sampling; damage_target, for planning.
"""
