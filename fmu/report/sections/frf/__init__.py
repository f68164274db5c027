"""The report section on frequency response functions."""
