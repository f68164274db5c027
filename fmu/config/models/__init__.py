"""``[model]``: the table for the structure, with one module for each type of model."""
