"""One file a command.

Reading order: run, check, report; then the others.
"""
