"""Sensor selection by expected information, an upper bound on it, and selection by customary rules."""
