"""What beam elements are made of: cross-sections and materials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval

from fmu.numbers import typed
from fmu.types import Positive, require_positive


@dataclass(frozen=True)
class Section:
    """Cross-section constants.

    Attributes
    ----------
    A : float
        Area, m².
    Iy, Iz : float
        Second moments of area ∫z² dA and ∫y² dA about the local axes, m⁴.
    J : float
        St-Venant torsion constant, m⁴.

    Raises
    ------
    ValueError
        If a constant is not positive and finite.
    """

    A: Positive
    Iy: Positive
    Iz: Positive
    J: Positive

    def __post_init__(self) -> None:
        for name in ("A", "Iy", "Iz", "J"):
            require_positive(name, getattr(self, name))

    @classmethod
    def rectangle(cls, width: Positive, height: Positive) -> Section:
        """Return the section of a rectangle, `width` along local y and `height` along local z, in m.

        The torsion constant is b t³/3 · (1 − 0.63 t/b + 0.052 (t/b)⁵) with the longer side b
        (Timoshenko & Goodier 1970, §109, the series cut after its leading terms).
        """
        require_positive("width", width)
        require_positive("height", height)
        b, t = max(width, height), min(width, height)
        J = b * t**3 / 3 * (1 - 0.63 * t / b + 0.052 * (t / b) ** 5)
        return cls(A=width * height, Iy=width * height**3 / 12, Iz=height * width**3 / 12, J=J)

    @classmethod
    def tube(cls, diameter: Positive, thickness: Positive) -> Section:
        """Return the section of a circular tube of outer `diameter` and wall `thickness`, in m.

        A = π (R² − r²), Iy = Iz = π/4 (R⁴ − r⁴) and J = 2 Iy, exactly; half the diameter as `thickness` makes it
        a solid rod.

        Raises
        ------
        ValueError
            If a dimension is not positive, or the wall is thicker than half the diameter.
        """
        require_positive("diameter", diameter)
        require_positive("thickness", thickness)
        if thickness > diameter / 2:
            raise ValueError(f"thickness: must not exceed half the diameter {typed(diameter)} (got {thickness})")
        outer, inner = diameter / 2, diameter / 2 - thickness
        second = np.pi / 4 * (outer**4 - inner**4)
        return cls(A=np.pi * (outer**2 - inner**2), Iy=second, Iz=second, J=2 * second)

    @classmethod
    def i_section(cls, height: Positive, width: Positive, web: Positive, flange: Positive) -> Section:
        """Return the section of a doubly symmetric I, in m; Iy belongs to bending in the plane of the web.

        `height` over all and the web lie along local z, the flanges of `width` along local y; `web` and `flange`
        are thicknesses. Fillets are left out. The torsion constant is Σ b t³/3 over the two flanges and the web
        between them (Timoshenko & Goodier 1970, §112).

        Raises
        ------
        ValueError
            If a dimension is not positive, the flanges leave no web, or the web is wider than the flanges.
        """
        for name, value in (("height", height), ("width", width), ("web", web), ("flange", flange)):
            require_positive(name, value)
        if 2 * flange >= height:
            raise ValueError(f"flange: must be thinner than half the height {typed(height)} (got {flange})")
        if web > width:
            raise ValueError(f"web: must not exceed the width {typed(width)} (got {web})")
        depth = height - 2 * flange
        return cls(
            A=2 * width * flange + web * depth,
            Iy=(width * height**3 - (width - web) * depth**3) / 12,
            Iz=(2 * flange * width**3 + depth * web**3) / 12,
            J=(2 * width * flange**3 + depth * web**3) / 3,
        )


@dataclass(frozen=True)
class Material:
    """Isotropic, linearly elastic material.

    Attributes
    ----------
    E : float
        Young's modulus, N/m².
    nu : float
        Poisson's ratio; the shear modulus is E / (2 (1 + nu)).
    rho : float
        Density, kg/m³.

    Raises
    ------
    ValueError
        If E or rho is not positive and finite, or nu does not lie in (-1, 0.5].
    """

    E: Positive
    nu: Annotated[float, Interval(gt=-1.0, le=0.5)]
    rho: Positive

    def __post_init__(self) -> None:
        require_positive("E", self.E)
        require_positive("rho", self.rho)
        if not -1.0 < self.nu <= 0.5:
            raise ValueError(f"nu: must lie in (-1, 0.5] (got {self.nu})")
