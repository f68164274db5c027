"""The evidence of a model, with its error and what it rests on.

Reading order: estimate, text.
"""
