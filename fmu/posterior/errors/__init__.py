"""Error models: how far measured and computed modes may differ.

Reading order: models, frequency, terms, joint; then noise, mixture, residual.
"""
