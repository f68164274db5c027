"""Tables of tests that have not been carried out yet."""
