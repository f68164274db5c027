"""A tapered, swept wing box of shells in Nastran's format: stringers, rigid ribs, a pylon on bushings, and fuel.

Skins and spars are CQUAD4, stringers CBAR, each rib an RBE2 from its centre to the ring of skin and spar nodes.
A pylon hangs on the centre of a rib by a CBUSH; fuel masses follow the skins between ribs by RBE3 of unequal
weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SPAN, CHORD, TIP_CHORD, SWEEP, HEIGHT = 9.0, 2.4, 1.1, 1.6, 0.16
"""m, the height relative to the chord."""
NAMES = ("E_skin", "E_spar", "E_stringer", "k_pylon")
NOMINAL = {"E_skin": 7.0e10, "E_spar": 7.1e10, "E_stringer": 7.2e10, "k_pylon": 4.0e6}


@dataclass(frozen=True)
class Wing:
    """A wing box.

    Attributes
    ----------
    bays : int
        Rows of elements along the span.
    chordwise, upright : int
        Elements of a skin along the chord, and of a spar along its height.
    ribs : int
        Number of ribs; `bays` is a multiple of it.
    """

    bays: int
    chordwise: int
    upright: int
    ribs: int

    @property
    def around(self) -> int:
        """Number of nodes, and of elements, around a section."""
        return 2 * (self.chordwise + self.upright)

    def node(self, station: int, k: int) -> int:
        """Return the number of node k of a section, from 0: along the lower skin, up, back, and down."""
        return 1 + station * self.around + k % self.around

    def rib(self, number: int) -> int:
        """Return the number of the centre of a rib, from 1."""
        return 90000 + number

    @property
    def pylon(self) -> int:
        """The number of the pylon's node."""
        return 95000

    def section(self, station: float) -> tuple[np.ndarray, float]:
        """Return the front lower corner (3,) and the chord of the section at a station."""
        y = SPAN * station / self.bays
        chord = CHORD + (TIP_CHORD - CHORD) * y / SPAN
        return np.array([SWEEP * y / SPAN, y, -0.5 * HEIGHT * chord]), chord

    def sensors(self) -> list[tuple[int, str]]:
        """Return accelerometers: at the spars of some ribs, whose nodes follow the ribs, and at the pylon."""
        found = []
        for rib in range(max(self.ribs // 6, 1), self.ribs + 1, max(self.ribs // 6, 1)):
            station = rib * self.bays // self.ribs
            found += [(self.node(station, 0), "z"), (self.node(station, self.chordwise), "z")]
        return [*found, (self.node(self.bays, 0), "x"), (self.pylon, "y"), (self.pylon, "z")]

    def template(self, output: str = "") -> str:
        """Return the deck with {E_skin:16} and others of NAMES; `output` goes into the executive control."""
        lines = ["SOL 103", *output.splitlines(), "CEND", "SPC = 1", "METHOD = 1", "VECTOR = ALL", "BEGIN BULK"]
        lines += ["EIGRL,1,,,10", "PARAM,GRDPNT,0", "PARAM,K6ROT,100."]
        for station in range(self.bays + 1):
            corner, chord = self.section(station)
            for k, (x, z) in enumerate(self._ring()):
                place = corner + np.array([0.55 * chord * x, 0.0, HEIGHT * chord * z])
                lines.append(f"GRID,{self.node(station, k)},," + ",".join(f"{value:.6f}" for value in place))
        element = 0
        for station in range(self.bays):
            for k in range(self.around):
                element += 1
                is_skin = (
                    k < self.chordwise or self.chordwise + self.upright <= k < 2 * self.chordwise + self.upright
                )
                ends = [(station, k), (station, k + 1), (station + 1, k + 1), (station + 1, k)]
                corners = ",".join(str(self.node(*end)) for end in ends)
                lines.append(f"CQUAD4,{element},{1 if is_skin else 2},{corners}")
        for k in (0, self.chordwise // 2, self.chordwise, self.chordwise + self.upright):
            for station in range(self.bays):
                element += 1
                ends = f"{self.node(station, k)},{self.node(station + 1, k)}"
                lines.append(f"CBAR,{element},3,{ends},0.,0.,1.")
        lines += self._ribs_and_masses(element)
        lines += ["PSHELL,1,1,0.004,1,,1", "PSHELL,2,2,0.006,2,,2", "PBAR,3,3,2.-4,2.-8,1.-8,2.-8"]
        for number, name in enumerate(NAMES[:3], 1):
            lines += [f"MAT1*{number:>19d}{{{name}:16}}{'':16s}{0.33:16.3f}", f"*{2780.0:>23.2f}"]
        lines += [f"PBUSH*{4:>18d}{'K':>16s}" + "{k_pylon:16}" * 2, "*       {k_pylon:16}" + f"{2e6:16.4E}" * 3]
        clamped = [str(self.node(0, k)) for k in range(self.around)]
        lines += [f"SPC1,1,123456,{','.join(clamped[at : at + 5])}" for at in range(0, len(clamped), 5)]
        return "\n".join([*lines, "ENDDATA"]) + "\n"

    def _ring(self) -> list[tuple[float, float]]:
        """Return the places of a section's nodes along chord and height, each from 0 to 1."""
        n, m = self.chordwise, self.upright
        lower, rear = [(k / n, 0.0) for k in range(n)], [(1.0, k / m) for k in range(m)]
        return lower + rear + [(1.0 - x, 1.0) for x, _ in lower] + [(0.0, 1.0 - z) for _, z in rear]

    def _ribs_and_masses(self, element: int) -> list[str]:
        lines = []
        for rib in range(1, self.ribs + 1):
            station = rib * self.bays // self.ribs
            corner, chord = self.section(station)
            place = corner + np.array([0.55 * chord * 0.5, 0.0, 0.5 * HEIGHT * chord])
            lines.append(f"GRID,{self.rib(rib)},," + ",".join(f"{value:.6f}" for value in place))
            ring = [self.node(station, k) for k in range(self.around)]
            lines += _entry("RBE2", 60000 + rib, self.rib(rib), 123456, *ring)
            lines += [
                f"CONM2,{70000 + rib},{self.rib(rib)},0,{4.0 * chord:.4f}",
                f",{0.3 * chord:.4f},,{0.4:.4f},,,{0.5:.4f}",
            ]
        engine = self.rib(max(self.ribs // 3, 1))
        corner, chord = self.section(max(self.ribs // 3, 1) * self.bays // self.ribs)
        place = corner + np.array([-0.4, 0.0, -0.3])
        lines += [f"GRID,{self.pylon},," + ",".join(f"{value:.6f}" for value in place)]
        lines += [f"CBUSH,{element + 1},4,{engine},{self.pylon},,,,0"]
        lines += [f"CONM2,{71000},{self.pylon},0,120.", ",9.,,11.,,,12."]
        for tank in range(1, self.ribs // 2):
            station = tank * self.bays // self.ribs + max(self.bays // self.ribs // 2, 1)
            corner, chord = self.section(station)
            node = 96000 + tank
            place = corner + np.array([0.2 * chord, 0.0, 0.4 * HEIGHT * chord])
            lines.append(f"GRID,{node},," + ",".join(f"{value:.6f}" for value in place))
            lower = [self.node(station, k) for k in range(1, self.chordwise)]
            upper = [self.node(station, self.chordwise + self.upright + k) for k in range(1, self.chordwise)]
            lines += _entry("RBE3", 61000 + tank, "", node, 123456, 3.0, 123, *lower, 1.0, 123, *upper)
            lines.append(f"CONM2,{72000 + tank},{node},0,{8.0 * chord:.4f}")
        return lines


def _entry(*words: object) -> list[str]:
    """Return the lines of an entry with any number of fields."""
    text = [str(word) for word in words]
    return [",".join(text[:9]), *(",".join(["", *text[at : at + 8]]) for at in range(9, len(text), 8))]


SMALL = Wing(bays=12, chordwise=6, upright=1, ribs=6)
LARGE = Wing(bays=72, chordwise=12, upright=2, ribs=24)
"""2016 CQUAD4, 288 CBAR, 24 RBE2 of 28 nodes each, 11 RBE3, 36 CONM2; 12 000 degrees of freedom."""
