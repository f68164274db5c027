"""What is computed of measured frequency response functions: estimates, resonances, modes and doubts.

Reading order: checks, estimates, peaks, doubts, identification.
"""
