"""The tables of `[model]` in a problem file.

Reading order: table; frame with sections, joints and targets; matrices; python.
"""
