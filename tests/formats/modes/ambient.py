"""A shear frame of three storeys in the wind: simulated accelerations, and what pyOMA_2 identifies in them.

Run as a script it writes ``ambient.npz``, which stands for pyOMA_2 in tests that must not depend on it.
"""

from pathlib import Path

import numpy as np
from scipy.linalg import eigh, expm

FIXTURE = Path(__file__).parent / "ambient.npz"
MASS = np.diag([2000.0, 2000.0, 1500.0])
STIFFNESS = np.array([3.0e6, 2.5e6, 2.0e6])
DAMPING = 0.01
RATE_HZ, SECONDS = 40.0, 600.0


def stiffness_matrix(k):
    return np.array([[k[0] + k[1], -k[1], 0.0], [-k[1], k[1] + k[2], -k[2]], [0.0, -k[2], k[2]]])


def exact_modes():
    """Return frequencies in Hz (3,) and shapes (3, 3), a column per mode."""
    values, shapes = eigh(stiffness_matrix(STIFFNESS), MASS)
    return np.sqrt(values) / (2 * np.pi), shapes


def record(seed):
    """Return the accelerations of the storeys, shape (n_samples, 3), under white noise on each, 5 % noise added.

    Modal equations, integrated exactly for a force that is constant over each step.
    """
    rng = np.random.default_rng(seed)
    values, shapes = eigh(stiffness_matrix(STIFFNESS), MASS)
    n, dt = int(SECONDS * RATE_HZ), 1.0 / RATE_HZ
    force = rng.standard_normal((n, 3)) @ shapes
    acceleration = np.zeros((n, 3))
    for k, omega in enumerate(np.sqrt(values)):
        A = np.array([[0.0, 1.0], [-(omega**2), -2 * DAMPING * omega]])
        step = expm(dt * A)
        push = np.linalg.solve(A, step - np.eye(2)) @ [0.0, 1.0]
        x, modal = np.zeros(2), np.empty(n)
        for i in range(n):
            modal[i] = A[1] @ x + force[i, k]
            x = step @ x + push * force[i, k]
        acceleration += np.outer(modal, shapes[:, k])
    return acceleration + 0.05 * acceleration.std(axis=0) * rng.standard_normal((n, 3))


def identified(seed):
    """Return pyOMA_2's SSIResult with standard deviations."""
    from pyoma2.algorithms import SSI
    from pyoma2.setup.single import SingleSetup

    setup = SingleSetup(record(seed), fs=RATE_HZ)
    algorithm = SSI(name="ssi", method="cov", br=15, ordmax=12, calc_unc=True, nb=40)
    setup.add_algorithms(algorithm)
    setup.run_all()
    setup.mpe("ssi", sel_freq=exact_modes()[0].tolist(), order_in=8)
    return setup["ssi"].result


if __name__ == "__main__":
    result = identified(1)
    np.savez(FIXTURE, **{name: getattr(result, name) for name in ("Fn", "Xi", "Phi", "Fn_std", "Phi_std")})
