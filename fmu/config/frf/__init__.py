"""Tables for measured frequency response functions and for damping.

Reading order: damping, errors, in_file.
"""
