"""Models that are solved by another program: started for every theta, or called in this process.

A Python function, a run of a program (`program_run`) and OpenSees are three callables behind the same `solves`.
Reading order: answers (what a callable returns), store (what was solved, on disk), solves (each made once),
sources (of which code a function is made), found_frequencies, program_run, command, opensees.
"""
