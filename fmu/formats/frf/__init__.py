"""Readers of measured frequency response functions: universal files, text tables, and arrays of NumPy and MATLAB.

Reading order: measured_frfs, read; then one file per format.
"""
