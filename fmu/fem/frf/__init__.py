"""Frequency response functions of a structure with damping, their derivatives, and their reduced model."""
