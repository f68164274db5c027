"""f = 100 + A theta: the model whose posterior is Gaussian."""

import numpy as np

SLOPES = np.array([[2.0, 1.0], [0.5, -1.0], [1.0, 3.0]])


class LinearModel:
    """Frequencies and nothing else, neither shapes nor matrices; it keeps every batch that it was asked for."""

    n_parameters = 2
    n_modes = 3

    def __init__(self):
        self.batches = []

    def __repr__(self):
        return "LinearModel()"

    def frequencies(self, theta):
        self.batches.append(np.array(theta))
        # Term by term: a matrix product would depend on the shape of the batch.
        return 100.0 + theta[:, :1] * SLOPES[:, 0] + theta[:, 1:] * SLOPES[:, 1]

    def frequencies_and_gradient(self, theta):
        return self.frequencies(theta), np.broadcast_to(SLOPES, (len(theta), 3, 2))

    @property
    def asked(self):
        """Every theta that it was asked for, shape (n, 2)."""
        return np.concatenate(self.batches)
