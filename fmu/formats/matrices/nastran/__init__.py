"""Readers for Nastran matrices: OP4 files, and DMIG entries in bulk data and punch files.

Reading order: cards, includes, dmig, op4.
"""
