"""Errors of measured frequency response functions, the damping that they need, and their likelihood."""
