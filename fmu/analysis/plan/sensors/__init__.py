"""Choices of sensors by their expected information, the bound of it, and choices by the customary rules."""
