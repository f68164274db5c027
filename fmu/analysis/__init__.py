"""The diagnosis: traces, convergence, comparison of samplers, prediction."""
