"""Readers for files from other programs: matrices, meshes, measured modes and frequency response functions.

To understand the code, first read the modules `files` and `shown`, and then the folders `matrices`, `constraints`,
`models`, `modes` and `frf`, which have separate modules for the file formats. `decks` fills in input decks.
"""
