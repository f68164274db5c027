"""``[model]``: the table of the structure, with one module for each type of model."""
