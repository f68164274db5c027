"""Measured frequency response functions: their errors, the damping that they require, and their likelihood."""
