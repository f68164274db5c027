"""The section on frequency response functions."""
