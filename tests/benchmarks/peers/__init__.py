"""fmu's samplers beside those that people use today, on the same posteriors and in one run."""
