"""A clamped plate of two materials as a deck of CalculiX, and what CalculiX says of it."""

from tests.formats.models.test_calculix import own, run

NOMINAL = {"E left": 7e10, "t": 0.04, "E right": 2e11, "rho": 2700.0}
LENGTH, WIDTH = 0.6, 0.3
COLUMNS, ROWS = 4, 2
MODES = 8


def corner(i, j):
    """Return the number of the node at column i and row j of a grid with midside nodes."""
    return (2 * COLUMNS + 1) * j + i + 1


def plate(solver="", **values):
    """Return the deck of shells S8; ``solver=", SOLVER=MATRIXSTORAGE"`` stores the matrices."""
    given = NOMINAL | {name.replace("_", " "): value for name, value in values.items()}
    grid = [(i, j) for j in range(2 * ROWS + 1) for i in range(2 * COLUMNS + 1) if not (i % 2 and j % 2)]
    nodes = [f"{corner(i, j)}, {LENGTH * i / (2 * COLUMNS)!r}, {WIDTH * j / (2 * ROWS)!r}, 0." for i, j in grid]
    around = ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1))
    sides = {"LEFT": range(COLUMNS // 2), "RIGHT": range(COLUMNS // 2, COLUMNS)}
    elements = []
    for side, columns in sides.items():
        elements.append(f"*ELEMENT, TYPE=S8, ELSET={side}")
        for i in columns:
            for j in range(ROWS):
                ends = ", ".join(str(corner(2 * i + a, 2 * j + b)) for a, b in around)
                elements.append(f"{1 + i * ROWS + j}, {ends}")
    sections = []
    for side, E, rho in (("LEFT", given["E left"], given["rho"]), ("RIGHT", given["E right"], 7850.0)):
        sections += [f"*MATERIAL, NAME={side}", "*ELASTIC", f"{E!r}, 0.3", "*DENSITY", repr(rho)]
        sections += [f"*SHELL SECTION, ELSET={side}, MATERIAL={side}", repr(given["t"])]
    held = ", ".join(str(corner(0, j)) for j in range(2 * ROWS + 1))
    step = ["*STEP", f"*FREQUENCY{solver}", str(MODES), "*NODE PRINT, NSET=ALL", "U", "*END STEP"]
    clamp = ["*NSET, NSET=CLAMP", held, *sections, "*BOUNDARY", "CLAMP, 1, 6"]
    return "\n".join(["*NODE, NSET=ALL", *nodes, *elements, *clamp, *step]) + "\n"


def exported(folder, name, **values):
    """Return the path of the stiffness that CalculiX stores with these values, the mass beside it."""
    return run(folder, name, plate(", SOLVER=MATRIXSTORAGE", **values)).with_suffix(".sti")


def frequencies(folder, **values):
    """Return the frequencies that CalculiX finds itself, Hz; it prints seven digits of the eigenvalues."""
    return own(run(folder, "own", plate(**values)), MODES)
