"""Readers for files from other programs: matrices, meshes, measured modes and frequency response functions.

Reading order: files, shown; then matrices, models, modes and frf, one file per format.
"""
