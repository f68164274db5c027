"""Frequency response functions (FRFs) of damped structures, their derivatives, and their reduced model."""
