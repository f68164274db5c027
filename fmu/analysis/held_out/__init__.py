"""Predictions of each measured mode from the other modes: leave-one-out checks, and modes not used in updating.

Reading order: refit, own_run, weights, modes.
"""
