"""A plate of shells, bars, bushings and masses in Nastran's format, whose constraints the tests choose."""

import subprocess

BUSH = "PBUSH,9,K,2.+5,2.+5,1.+5,50.,40.,30."


def number_of(i, j, ny):
    """Return the number of the node in column i and row j of a plate with ny rows of elements."""
    return 1 + i * (ny + 1) + j


def plate(values, entries, case="", nx=6, ny=2, output="KGG,MGG", axes=None):
    """Return the deck of a cantilever plate of 0.9 m × 0.3 m with a stiffener and a mass on a bushing.

    Parameters
    ----------
    values : dict
        Young's moduli E1 and E2 of the halves, thickness t2 of the outer half, E3 of the stiffener, m of the mass.
    entries : str
        Constraints, and further nodes and masses.
    case : str
        Lines of the case control.
    nx, ny : int
        Elements along and across.
    output : str
        Names of the matrices to write.
    axes : dict of int to int
        Coordinate systems of nodes: 1 is turned about z, 2 is cylindrical.
    """
    lines = ["SOL 103", f"OUTPUT4 {output},,,//-1/21", "CEND", "SPC = 1", "METHOD = 1", "VECTOR = ALL"]
    lines += [*case.splitlines(), "BEGIN BULK", "EIGRL,1,,,6", "PARAM,GRDPNT,0"]
    lines += ["CORD2R,1,,0.,0.,0.,0.,0.,1.", ",1.,1.,0.", "CORD2C,2,,0.4,-.3,0.,0.4,-.3,1.", ",1.,0.,0."]
    for i in range(nx + 1):
        for j in range(ny + 1):
            node = number_of(i, j, ny)
            lines.append(f"GRID,{node},,{0.9 * i / nx:.6f},{0.3 * j / ny:.6f},0.,{(axes or {}).get(node, 0)}")
    for i in range(nx):
        for j in range(ny):
            corners = [
                number_of(i, j, ny),
                number_of(i + 1, j, ny),
                number_of(i + 1, j + 1, ny),
                number_of(i, j + 1, ny),
            ]
            lines.append(f"CQUAD4,{1 + i * ny + j},{1 if i < nx // 2 else 2}," + ",".join(map(str, corners)))
    lines += [f"CBAR,{9000 + i},3,{number_of(i, 0, ny)},{number_of(i + 1, 0, ny)},0.,0.,1." for i in range(nx)]
    middle = number_of(nx // 2, ny // 2, ny)
    lines += [
        f"GRID,8000,,{0.9 * (nx // 2) / nx:.6f},{0.3 * (ny // 2) / ny:.6f},0.1,,6",
        f"CBUSH,9800,9,{middle},8000,,,,0",
        BUSH,
    ]
    lines += [f"CONM2,9900,8000,0,{values['m']:.7f}", ",.01,,.02,,,.03"]
    lines += ["PSHELL,1,1,0.008,1,,1", f"PSHELL,2,2,{values['t2']:.5f},2", "PBAR,3,3,1.-4,1.-9,2.-9,2.-9"]
    for material, name in (1, "E1"), (2, "E2"), (3, "E3"):
        lines += [f"MAT1*{material:>19d}{values[name]:16.9E}{'':16s}{0.3:16.3f}", f"*{7850.0:>23.2f}"]
    clamped = [number_of(0, j, ny) for j in range(ny + 1)]
    lines += (
        ["SPC1,1,123456," + ",".join(map(str, clamped))]
        if len(clamped) < 6
        else [f"SPC1,1,123456,{clamped[0]},THRU,{clamped[-1]}"]
    )
    return "\n".join([*lines, *entries.splitlines(), "ENDDATA"]) + "\n"


def run(program, folder, text):
    """Solve a deck in a folder with MYSTRAN and return the path of the deck."""
    folder.mkdir(parents=True, exist_ok=True)
    deck = folder / "job.bdf"
    deck.write_text(text)
    subprocess.run([program, deck.name], cwd=folder, capture_output=True, check=True, timeout=300)
    return deck
