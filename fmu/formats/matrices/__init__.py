"""Stiffness and mass matrices from files of other programs.

Reading order: read, files; then one file a format.
"""
