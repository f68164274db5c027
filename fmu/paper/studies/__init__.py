"""Studies that go beyond the paper: a separate β for every mode, and a model that may be wrong.

Reading order: moments, vector_beta, wrong_model.
"""
