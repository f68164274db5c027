"""Predictions of each measured mode from the other modes: leave-one-out checks, and modes not used in updating.

The posterior obtained by updating without a mode is the mode's leave-one-out posterior. Reading order: refit,
own_run, weights, modes.
"""
