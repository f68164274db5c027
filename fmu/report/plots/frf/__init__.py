"""Figures of frequency response functions."""
