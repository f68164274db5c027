"""What the paper printed, and what is wrong with it.

Reading order: tables, errata, recomputed, spectrum, claims.
"""
