"""Models that are solved by a Python function, by an external program or by OpenSees.

The function, the program run and the OpenSees model are callables with the same interface: `solves` calls them
and stores their results.
Reading order: answers (the results of a callable), store (solves on disk), solves (each theta is solved once),
sources (a function's source files), found_frequencies, deck_run, program_run, command, export_runs, followers,
opensees.
"""
