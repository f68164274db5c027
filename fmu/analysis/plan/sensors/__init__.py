"""Choices of sensors by their expected information, an upper bound of it, and choices by the customary rules."""
