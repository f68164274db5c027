"""``[model]``: the structure, a module for each type."""
