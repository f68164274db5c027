"""Pairing of computed modes with measured modes, and comparison of their shapes.

Read rules, prediction, modal_model and paired_structure first. paired_black_box pairs the modes of a user's
function, failed_solves explains why a solve failed, and matching assigns measurement points to mesh nodes.
"""
