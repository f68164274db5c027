"""Errors of a model that is wrong, beside the errors of the measurement. Reading order: embedded, likelihood."""
