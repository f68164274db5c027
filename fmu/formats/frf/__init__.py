"""Readers for measured frequency response functions: universal files, text tables, NumPy and MATLAB arrays.

Reading order: measured_frfs, read; then one file per format.
"""
