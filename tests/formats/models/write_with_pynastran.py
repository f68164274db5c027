"""Write a frame of fmu as files of Nastran, by pyNastran and pyYeti: the files in ``nastran/``.

pyNastran needs NumPy below 2, so that it has an environment of its own, without fmu::

    python -m tests.formats.models.write_with_pynastran frame.npz
    python -m venv nastran-env && nastran-env/bin/pip install 'numpy<2' pyNastran pyyeti
    nastran-env/bin/python tests/formats/models/write_with_pynastran.py frame.npz tests/formats/models/nastran

pyNastran 1.4.1 writes the heads of the columns of binary OP4 files as real numbers, which no program reads: the
binary files are pyYeti's.
"""

import sys
from pathlib import Path

import numpy as np

IDS = (101, 205, 303, 410, 1004)
"""Of the nodes of `portal`."""
TURNED = {205: 7, 303: 8, 410: 9}
"""Output coordinate systems of nodes: rectangular, cylindrical, spherical."""


def portal():
    """A portal in space of five nodes, clamped at the first and the last."""
    import fmu

    nodes = [[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [2.0, 0.5, 3.5], [4.0, 0.0, 3.0], [4.0, 0.0, 0.0]]
    members = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    section, steel = fmu.Section.rectangle(0.2, 0.1), fmu.Material(E=2.1e11, nu=0.3, rho=7850.0)
    clamped = ("x", "y", "z", "rx", "ry", "rz")
    frame = fmu.Frame(nodes, [fmu.ElementGroup("all", members, section, steel)], supports={0: clamped, 4: clamped})
    return frame.separable({"E": [("E", "all")]})


def write_frame(path):
    """Write matrices on all 30 rows, with empty ones at the clamped nodes, and coordinates."""
    model = portal()
    rows = [6 * node + ("x", "y", "z", "rx", "ry", "rz").index(direction) for node, direction in model.dofs]
    matrices = {}
    for name, part in (("K", model.K([2.1e11])), ("M", model.M([2.1e11]))):
        matrices[name] = np.zeros((30, 30))
        matrices[name][np.ix_(rows, rows)] = part.toarray()
    np.savez(path, nodes=model.geometry.nodes, elements=model.geometry.elements, **matrices)


def write_files(source, folder):
    """Write the decks, OP4 files and DMIG entries."""
    from pyNastran.bdf.bdf import BDF, DMIG
    from pyNastran.op4.op4 import OP4
    from pyyeti.nastran import op4 as yeti
    from scipy.sparse import coo_matrix

    frame = np.load(source)
    K, M, nodes = frame["K"], frame["M"], frame["nodes"]

    def deck(turned):
        model = BDF(debug=False)
        model.add_cord2r(7, [1.0, 2.0, 3.0], [2.0, 2.0, 4.0], [1.0, 3.0, 3.5])
        model.add_cord2c(8, [0.5, -1.0, 0.0], [0.5, -1.0, 1.0], [1.5, -1.0, 0.0])
        model.add_cord2s(9, [0.5, -0.5, 0.2], [0.5, 0.5, 1.2], [1.5, -0.5, 0.2], rid=7)
        for node, place in zip(IDS, nodes, strict=True):
            system = turned.get(node, 0)
            model.add_grid(node, place, cp=0, cd=system, ps="123456" if node in (101, 1004) else "")
        model.cross_reference()
        for node in turned:  # the places of the same nodes in the systems that their motions are in
            grid = model.nodes[node]
            grid.xyz = grid.cd_ref.transform_node_to_local(grid.xyz)
            grid.cp, grid.cp_ref = grid.cd, grid.cd_ref
        for number, (a, b) in enumerate(frame["elements"], 1):
            model.add_cbar(number, 1, [IDS[a], IDS[b]], [0.0, 1.0, 0.0], None)
        return model

    def axes(model):
        """The unit vectors of each node's system by small steps along its coordinates, as rows."""
        rotation = np.eye(30)
        for k, node in enumerate(IDS):
            grid = model.nodes[node]
            if not grid.cd:
                continue
            at, system = grid.xyz, grid.cd_ref
            steps = np.array(
                [
                    system.transform_node_to_global(at + h) - system.transform_node_to_global(at - h)
                    for h in 1e-3 * np.eye(3)
                ]
            )
            own = steps / np.linalg.norm(steps, axis=1)[:, None]
            rotation[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = rotation[
                6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6
            ] = own
        return rotation

    plain, turned = deck({}), deck(TURNED)
    T = axes(turned)
    assert np.allclose(T @ T.T, np.eye(30), atol=1e-9)
    plain.write_bdf(folder / "portal.bdf", size=8)
    turned.write_bdf(folder / "turned.bdf", size=16, is_double=True)

    names = ("KGG", "MGG")
    writer = OP4()
    dense = {name: (6, matrix) for name, matrix in zip(names, (K, M), strict=True)}
    sparse = {name: (6, coo_matrix(matrix)) for name, matrix in zip(names, (K, M), strict=True)}
    writer.write_op4(str(folder / "dense.op4"), dense, name_order=list(names), is_binary=False)
    writer.write_op4(str(folder / "sparse.op4"), sparse, name_order=list(names), is_binary=False)
    for name, how, order in (
        ("little.op4", "dense", "<"),
        ("big.op4", "dense", ">"),
        ("strings.op4", "nonbigmat", ">"),
        ("bigmat.op4", "bigmat", "<"),
    ):
        yeti.write(str(folder / name), list(names), [K, M], binary=True, sparse=how, endian=order)
    yeti.write(str(folder / "bigmat-text.op4"), list(names), [K, M], binary=False, sparse="bigmat", digits=16)
    yeti.write(str(folder / "turned.op4"), list(names), [T @ K @ T.T, T @ M @ T.T], binary=True)
    free = np.flatnonzero(K.diagonal())
    yeti.write(str(folder / "free.op4"), ["KFF", "MFF"], [K[np.ix_(free, free)], M[np.ix_(free, free)]])

    places = [(node, component) for node in IDS for component in range(1, 7)]
    for name, type_ in (("small", 1), ("large", 2)):
        model = BDF(debug=False)
        for title, matrix in (("KAAX", K), ("MAAX", M)):
            rows, columns = np.nonzero(np.triu(matrix))
            model.dmig[title] = DMIG(
                title, 6, type_, 0, 0, None,
                [places[c] for c in columns], [places[r] for r in rows], list(matrix[rows, columns]),
            )  # fmt: skip
        text = "".join(one.write_card(8) for one in model.dmig.values())
        (folder / f"{name}.pch").write_text("$TITLE   = PORTAL\n" + text)
    write_long(folder / "long.op4", K, M)
    for name, matrix in yeti.read(str(folder / "long.op4")).items():
        assert np.array_equal(matrix, {"kgg": K, "mgg": M}[name])
    write_modes(K, M, T, folder / "turned.f06")


def write_long(path, K, M):
    """Write OP4 with words of 8 bytes, the stiffness with full columns and the mass with strings.

    Neither program writes it, and pyYeti reads it.
    """

    def record(file, content):
        size = np.array([len(content)], "<i4").tobytes()
        file.write(size + content + size)

    def whole(*numbers):
        return np.array(numbers, "<i8").tobytes()

    n = len(K)
    with open(path, "wb") as file:
        for name, matrix, rows in (("KGG", K, n), ("MGG", M, -n)):
            record(file, whole(n, rows, 6, 2) + name.ljust(16).encode())
            for j, column in enumerate(matrix.T, 1):
                there = np.flatnonzero(column)
                parts = np.split(there, np.flatnonzero(np.diff(there) > 1) + 1) if len(there) else []
                if rows < 0 and parts:
                    words = [whole(len(part) + 1, part[0] + 1) + column[part].tobytes() for part in parts]
                    record(file, whole(j, 0, sum(map(len, words)) // 8) + b"".join(words))
                elif parts:
                    values = column[there[0] : there[-1] + 1]
                    record(file, whole(j, there[0] + 1, len(values)) + values.tobytes())
            record(file, whole(n + 1, 1, 1) + np.ones(1).tobytes())


def write_modes(K, M, T, path):
    """Print four modes along the axes T of the nodes."""
    from pyNastran.op2.tables.lama_eigenvalues.lama_objects import RealEigenvalues
    from pyNastran.op2.tables.oug.oug_eigenvectors import RealEigenvectorArray
    from scipy.linalg import eigh

    free, n = np.flatnonzero(K.diagonal()), 4
    squares, vectors = eigh(K[np.ix_(free, free)], M[np.ix_(free, free)])
    omega = np.sqrt(squares[:n])
    shapes = np.zeros((n, 30))
    shapes[:, free] = vectors[:, :n].T
    table = RealEigenvalues("PORTAL", "REAL EIGENVALUES", n)
    for k in range(n):
        row = (k + 1, k + 1, squares[k], omega[k], omega[k] / (2.0 * np.pi), 1.0, squares[k])
        table.add_f06_line(row, k)
    nodes = np.array([[node, 1] for node in IDS])
    modes = RealEigenvectorArray.add_modal_case(
        "OUGV1", nodes, (shapes @ T.T).reshape(n, 5, 6), 1, np.arange(1, n + 1), squares[:n], omega / (2.0 * np.pi)
    )
    with open(path, "w") as file:
        table.write_f06(file, ["1    PORTAL\n", "\n"], "1    PAGE %s\n", 1)
        modes.write_f06(file, ["1    PORTAL\n", "\n"], "1    PAGE %s\n", 2)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        write_frame(Path(sys.argv[1]))
    else:
        write_files(Path(sys.argv[1]), Path(sys.argv[2]))
