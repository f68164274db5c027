"""Which mode is which, before and after updating.

Reading order: initial_modes, pairing_doubts, pairing_changes, mode_text.
"""
