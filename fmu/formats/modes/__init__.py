"""Measured modes from files: CSV, UFF, pyOMA.

Reading order: measured_modes; then one file a format.
"""
