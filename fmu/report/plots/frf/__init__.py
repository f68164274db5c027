"""Plots of frequency response functions."""
