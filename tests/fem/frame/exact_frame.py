"""Exact natural frequencies of spatial frames by dynamic stiffness, written without any of fmu's matrices.

Members are Rayleigh beams (bending with rotary inertia), bars and shafts, solved exactly between their ends
(Kolousek 1941). Each is cut so short that its pieces have no natural frequency below those wanted while their ends
are clamped; the number of frequencies below ω is then the number of negative eigenvalues of D(ω) (Wittrick &
Williams 1971).
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class Member:
    """From a to b (m); EA, GJ, EI and mass constants for bending along the unit vectors y and z."""

    a: np.ndarray
    b: np.ndarray
    EA: float
    GJ: float
    EIy: float
    EIz: float
    mass: float
    rotary_y: float
    rotary_z: float
    y: np.ndarray


def rod(stiffness, mass, length, omega):
    """Dynamic stiffness of a bar or shaft, 2 x 2."""
    k = omega * np.sqrt(mass / stiffness)
    return stiffness * k / np.sin(k * length) * np.array([[np.cos(k * length), -1], [-1, np.cos(k * length)]])


def bending(EI, mass, rotary, length, omega):
    """Dynamic stiffness of (w, w') at both ends from EI w'''' + ρI ω² w'' − ρA ω² w = 0, 4 x 4."""
    p, q = rotary * omega**2 / EI, mass * omega**2 / EI
    root = np.sqrt(p**2 + 4 * q)
    a, b = np.sqrt((root + p) / 2), np.sqrt((root - p) / 2)

    def derivatives(x):
        """Rows are the derivatives 0 … 3 of cos ax, sin ax, cosh bx, sinh bx."""
        c, s, C, S = np.cos(a * x), np.sin(a * x), np.cosh(b * x), np.sinh(b * x)
        return np.array(
            [
                [c, s, C, S],
                [-a * s, a * c, b * S, b * C],
                [-(a**2) * c, -(a**2) * s, b**2 * C, b**2 * S],
                [a**3 * s, -(a**3) * c, b**3 * S, b**3 * C],
            ]
        )

    left, right = derivatives(0.0), derivatives(length)
    shear = [EI * d[3] + rotary * omega**2 * d[1] for d in (left, right)]
    forces = np.array([shear[0], -EI * left[2], -shear[1], EI * right[2]])
    return forces @ np.linalg.inv(np.array([left[0], left[1], right[0], right[1]]))


def member_stiffness(member, omega):
    """Dynamic stiffness in global axes, 12 x 12."""
    length = np.linalg.norm(member.b - member.a)
    x = (member.b - member.a) / length
    z = np.cross(x, member.y)
    D = np.zeros((12, 12))

    def add(rows, matrix):
        """Rows are six-vectors of one end's motion that each local coordinate measures."""
        T = np.zeros((len(matrix), 12))
        for i, (end, motion) in enumerate(rows):
            T[i, 6 * end : 6 * end + 6] = motion
        D[:] += T.T @ matrix @ T

    none = np.zeros(3)
    add([(0, [*x, *none]), (1, [*x, *none])], rod(member.EA, member.mass, length, omega))
    add([(0, [*none, *x]), (1, [*none, *x])], rod(member.GJ, member.rotary_y + member.rotary_z, length, omega))
    # the slope of w along the local axis d is the rotation about x × d
    for d, EI, rhoI in ((member.y, member.EIz, member.rotary_z), (z, member.EIy, member.rotary_y)):
        turn = np.cross(x, d)
        rows = [(end, motion) for end in (0, 1) for motion in ([*d, *none], [*none, *turn])]
        add(rows, bending(EI, member.mass, rhoI, length, omega))
    return D


def pieces(member, top):
    """The member cut so that no piece, clamped at both ends, vibrates below the angular frequency `top`."""
    length = np.linalg.norm(member.b - member.a)
    waves = [np.sqrt(member.EA / member.mass), np.sqrt(member.GJ / (member.rotary_y + member.rotary_z))]
    longest = [np.pi * speed / top for speed in waves]
    # Euler–Bernoulli's first one is 22.37 √(EI/ρA)/L²; rotary inertia halves it at most in what is tested here
    longest += [np.sqrt(11.0 / top * np.sqrt(EI / member.mass)) for EI in (member.EIy, member.EIz)]
    cuts = int(np.ceil(1.1 * length / min(longest)))
    points = [member.a + (member.b - member.a) * k / cuts for k in range(cuts + 1)]
    return [replace(member, a=a, b=b) for a, b in pairwise(points)]


def assembled(parts, omega, fixed=(), springs=()):
    """D(ω) of members, without the points of `fixed`; springs are (point, 6 x 6)."""
    points = []

    def number(point):
        for i, other in enumerate(points):
            if np.linalg.norm(point - other) < 1e-9:
                return i
        points.append(point)
        return len(points) - 1

    ends = [(number(part.a), number(part.b)) for part in parts]
    D = np.zeros((6 * len(points),) * 2)
    for (i, j), part in zip(ends, parts, strict=True):
        dofs = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        D[np.ix_(dofs, dofs)] += member_stiffness(part, omega)
    for point, matrix in springs:
        k = 6 * number(np.asarray(point, float))
        D[k : k + 6, k : k + 6] += matrix
    held = [6 * number(np.asarray(point, float)) + k for point in fixed for k in range(6)]
    free = np.setdiff1d(np.arange(len(D)), held)
    return D[np.ix_(free, free)]


def frequencies(members, count, fixed=(), springs=(), top=250.0):
    """The lowest natural frequencies in Hz, all below `top`, by bisection of the number below ω."""
    top *= 2 * np.pi
    parts = [piece for member in members for piece in pieces(member, top)]

    def below(omega):
        return np.sum(np.linalg.eigvalsh(assembled(parts, omega, fixed, springs)) < 0)

    assert below(top) >= count
    found = []
    for k in range(1, count + 1):
        low, high = found[-1] * 0.999999 if found else 1e-3, top
        while high - low > 1e-9 * high:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if below(middle) >= k else (middle, high)
        found.append(0.5 * (low + high))
    return np.array(found) / (2 * np.pi)
