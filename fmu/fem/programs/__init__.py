"""Models that are solved by another program: started for every theta, or called in this process.

Reading order: store (what was solved, on disk), sources (of which code a function is made), command, opensees.
"""
