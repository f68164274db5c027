"""What is computed from measured frequency response functions before updating: estimates, resonances and doubts.

Reading order: checks, estimates, peaks, doubts.
"""
