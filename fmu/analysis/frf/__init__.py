"""Frequency response functions (FRFs) at the draws of a run: predictions, misfit, and checks of the model."""
