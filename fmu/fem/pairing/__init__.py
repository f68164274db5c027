"""Pairing of computed modes with measured modes.

Reading order: rules, prediction, modal_model, paired_structure; paired_black_box for a user's function,
failed_solves for the reasons why solves fail.
"""
