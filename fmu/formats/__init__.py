"""Files of other programs: matrices and measurements."""
