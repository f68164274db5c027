"""Tables of tests that have not been made yet."""
