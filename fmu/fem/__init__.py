"""Structural models: from theta to K(theta), M(theta), frequencies, mode shapes and their derivatives."""
