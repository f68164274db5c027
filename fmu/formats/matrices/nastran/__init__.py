"""Readers of Nastran matrices: OP4 files, and DMIG entries of the bulk data and the punch file.

Reading order: cards, dmig, op4.
"""
