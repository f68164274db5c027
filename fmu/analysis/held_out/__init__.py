"""How the other modes predict each measured one: leave-one-out checks, and modes not used in updating.

Reading order: refit, weights, modes.
"""
