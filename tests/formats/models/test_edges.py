"""The lines that draw a mesh."""

import numpy as np
import pytest

from fmu.formats.models.edges import MOST_EDGES, edges, inside
from fmu.formats.models.exported import mesh_of


def plate(n, kind="quad"):
    """n × n quads, ids from 1 in steps of 3."""
    places = {1 + 3 * (i * (n + 1) + j): (i / n, j / n, 0.0) for i in range(n + 1) for j in range(n + 1)}

    def at(i, j):
        return 1 + 3 * (i * (n + 1) + j)

    quads = [(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)) for i in range(n) for j in range(n)]
    return mesh_of(places, quads, [kind] * n * n)


def bricks(n):
    """n³ bricks."""
    m = n + 1
    places = {1 + i + m * (j + m * k): (i, j, k) for i in range(m) for j in range(m) for k in range(m)}
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    elements = [
        tuple(1 + (i + a) + m * ((j + b) + m * (k + c)) for a, b, c in corners)
        for i in range(n)
        for j in range(n)
        for k in range(n)
    ]
    return mesh_of(places, elements, ["hexahedron"] * n**3)


def test_nodes_inside_solids():
    """27 of 125 nodes of 4³ bricks; of the midside nodes, those between two outer nodes are on the surface."""
    mesh = bricks(4)
    within = mesh.coordinates[inside(mesh)]
    assert len(within) == 27
    assert within.min() == 1.0
    assert within.max() == 3.0
    assert len(inside(plate(4))) == 0
    first = mesh.elements[0]
    sides = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    ends = np.array(first)[np.array(sides)] - 1
    middle = dict(enumerate(mesh.coordinates[ends].mean(axis=1), 1001))
    places = dict(zip(mesh.nodes.tolist(), mesh.coordinates, strict=True)) | middle
    finer = mesh_of(places, ((*first, *middle), *mesh.elements[1:]), ("hexahedron20", *mesh.kinds[1:]))
    midside = {int(node) for node in finer.nodes[inside(finer)] if node > 1000}
    assert midside == {node for node, place in middle.items() if min(place) > 0.0}


def split_bricks(n, parts, kind):
    """n³ bricks, each divided into solids (indices of the brick's corners); tetrahedra begin at random corners."""
    mesh, rng = bricks(n), np.random.default_rng(1)
    even = [(0, 1, 2, 3), (1, 2, 0, 3), (1, 0, 3, 2), (3, 1, 0, 2)] if kind == "tetra" else [range(len(parts[0]))]
    solids = [
        tuple(brick[part[k]] for k in even[rng.integers(len(even))]) for brick in mesh.elements for part in parts
    ]
    return mesh_of(dict(zip(mesh.nodes.tolist(), mesh.coordinates, strict=True)), solids, [kind] * len(solids))


@pytest.mark.parametrize(
    ("kind", "parts", "lines"),
    [
        ("hexahedron", [tuple(range(8))], 0),
        (
            "tetra",
            [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)],
            6 * 4**2,
        ),
        ("wedge", [(0, 1, 2, 4, 5, 6), (2, 3, 0, 6, 7, 4)], 2 * 4**2),
    ],
)
def test_nodes_inside_solids_of_triangles(kind, parts, lines):
    """27 of 125 nodes are inside; the edges of the surface are those of the bricks, and the diagonals of faces."""
    mesh = split_bricks(4, parts, kind)
    assert set(inside(mesh).tolist()) == set(inside(bricks(4)).tolist())
    assert len(edges(mesh)) == 6 * (2 * 4 * 5) - 12 * 4 + lines


def test_each_edge_of_a_small_mesh_once():
    mesh = plate(4)
    assert len(edges(mesh)) == 2 * 4 * 5
    assert edges(mesh).max() == len(mesh.nodes) - 1
    assert len(edges(bricks(1))) == 12
    assert (
        len(edges(bricks(3))) == 6 * (2 * 3 * 4) - 12 * 3
    )  # on the surface; those of the cube belong to two sides


def test_of_many_edges_those_that_show_the_shape():
    mesh = plate(70)
    drawn = edges(mesh)
    assert len(drawn) <= 2 * MOST_EDGES
    at = mesh.coordinates[drawn]
    on_border = np.any((at == 0.0).all(axis=1) | (at == 1.0).all(axis=1), axis=1) & np.any(
        at[:, :, :2].min(axis=1) != at[:, :, :2].max(axis=1), axis=1
    )
    assert on_border.sum() >= 4 * 70
    assert len(edges(bricks(20))) < 4000


@pytest.mark.parametrize(
    ("kind", "count", "lines"),
    [("tetra", 4, 6), ("wedge", 6, 9), ("pyramid", 5, 8), ("triangle6", 6, 3), ("line3", 3, 1)],
)
def test_edges_of_one_element(kind, count, lines):
    places = {i + 1: (i, i**2, i**3) for i in range(count)}
    assert len(edges(mesh_of(places, [tuple(places)], [kind]))) == lines


def test_elements_without_lines():
    assert edges(mesh_of({5: (0.0, 0.0, 0.0)}, [(5,)], ["vertex"])).shape == (0, 2)
