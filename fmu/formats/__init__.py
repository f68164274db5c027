"""Readers for files from other programs: matrices, meshes, measured modes and frequency response functions.

Reading order: files, shown; then matrices, constraints, models, modes and frf, with a file for each format.
"""
