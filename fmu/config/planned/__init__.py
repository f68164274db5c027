"""Tables for tests that have not been carried out yet."""
