"""Stiffness and mass matrices from files of other programs.

Reading order: read, readers, limits; then one file a format.
"""
