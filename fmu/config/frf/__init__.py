"""Tables of measured frequency response functions and of damping.

Reading order: damping, errors.
"""
