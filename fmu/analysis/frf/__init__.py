"""Frequency response functions at the draws of a run: predictions, misfit, and checks of the model with them."""
