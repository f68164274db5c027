"""Files of other programs: matrices and measured modes.

Reading order: files, shown; then matrices and modes, one file a format.
"""
