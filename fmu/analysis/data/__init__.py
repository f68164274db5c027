"""What the data say: fit, prediction, and which parameters they update.

Reading order: model_fit, prediction, identifiability, information, uninformed, repeatability.
"""
