"""Process measured frequency response functions: estimates, resonances, modes and warnings.

Reading order: checks, estimates, peaks, student, correlation, doubts, identification.
"""
