"""Readers of files from other programs: matrices, meshes and measured modes.

Reading order: files, shown; then matrices, models and modes, one file per format.
"""
