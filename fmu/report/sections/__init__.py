"""The sections of a report, an idea a file. Each function takes a run and returns a section."""
