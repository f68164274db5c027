"""The structure: theta -> K(theta), M(theta) -> frequencies, shapes and their derivatives."""
