"""Whole runs of samplers, from nothing to so many effective draws, with everything that they cost."""
