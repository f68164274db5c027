"""Frequency response functions at the draws of a run: predictions, misfit, and the check of the model by them."""
