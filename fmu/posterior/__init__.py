"""The question: what was known, what was measured, and how probable theta is."""
