"""Constraint equations in an archive of Ansys, as CDWRITE has them."""

import pytest

from fmu.formats.constraints.ansys import equations_of
from fmu.formats.matrices.limits import RefusedError

ARCHIVE = """\
/PREP7
CE,R5.0,DEFI,       3,       1,  0.00000000
CE,R5.0,NODE,      12,UX  ,  2.00000000    ,      40,UX  , -1.00000000
CE,R5.0,NODE,      40,ROTZ,  0.50000000
CE,R5.0,DEFI,       2,       1,  0.00000000
CE,R5.0,NODE,      13,ROTY,  1.00000000    ,      40,ROTY, -1.00000000
CP,R5.0,DEFI,       2,       1,UX
FINISH
"""


def test_equations_of_two_terms_a_line():
    equations, notes, unread = equations_of(ARCHIVE.splitlines())
    assert [one.dependent for one in equations] == [(12, "x"), (13, "ry")]
    assert equations[0].weights == {(40, "x"): 0.5, (40, "rz"): -0.25}
    assert equations[1].weights == {(40, "ry"): 1.0}
    assert unread == ("1 CP",)
    assert notes == ["1 couplings (CP,R5.0,DEFI) are not read: write each as CP,number,direction,nodes."]


def test_constants_of_equations_are_left_out_with_a_note():
    shifted = ARCHIVE.replace("1,  0.00000000", "1,  0.25000000", 1)
    equations, notes, _ = equations_of(shifted.splitlines())
    assert [one.weights for one in equations] == [one.weights for one in equations_of(ARCHIVE.splitlines())[0]]
    assert notes[1:] == ["The constants of 1 equations (CE) are left out: they do not change the modes."]
    assert len(equations_of(ARCHIVE.replace("1,  0.00000000", "1", 1).splitlines())[1]) == 1


def test_coupled_sets_follow_their_first_node():
    """As the command has them: HIGH adds to the highest set, NEXT begins one, a set may go on."""
    lines = ["CP,4,UX,12,13,14", "CP,4,,15,12", "CP,HIGH,UX,16", "cp,next,rotz,7,8", "CP,1,UY,12,13"]
    equations, notes, unread = equations_of(lines)
    found = {one.dependent: dict(one.weights) for one in equations}
    assert found == {
        **{(node, "x"): {(12, "x"): 1.0} for node in (13, 14, 15, 16)},
        (8, "rz"): {(7, "rz"): 1.0},
        (13, "y"): {(12, "y"): 1.0},
    }
    assert not notes
    assert not unread


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("CP,1,TEMP,12,13", r"CP 1 must have a direction of UX.*got 'TEMP'"),
        ("CP,1,UX", r"and nodes \(got 'UX', 0 nodes"),
        ("CP,1,,12", r"must have a direction"),
        ("CP,1,ALL,12,13", r"got 'ALL'"),
        ("CP,one,UX,12", r"number of a set must be a whole number \(got 'ONE'"),
        ("CP,1,UX,12,-13", r"CP 1: a node must be a whole number \(got '-13'"),
        ("CP", None),
        ("CP,", r"must have a direction"),
    ],
)
def test_broken_sets_are_refused(line, message):
    if message is None:
        assert equations_of([line]) == ([], [], ())
        return
    with pytest.raises(ValueError, match=message):
        equations_of([line])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("      40,ROTZ,  0.50000000", "", r"CE 1 must have 1 more terms"),
        ("DEFI,       3", "DEFI,       2", r"has more"),
        ("DEFI,       3", "DEFI,   three", r"number of terms must be a whole number"),
        ("DEFI,       3", "DEFI, 9999999999", r"at most \d+ equations and terms"),
        ("ROTZ", "TEMP", r"a direction must be one of UX.*got 'TEMP'"),
        ("0.00000000", "nothing", r"CE 1: the constant must be a real number"),
        ("-1.00000000", "minus one", r"CE 1: a factor must be a real number"),
        ("2.00000000", "0.00000000", r"CE 1: the factor of node 12 x is zero"),
        ("12,UX", "-12,UX", r"CE 1: a node must be a whole number"),
    ],
)
def test_broken_equations_are_refused(old, new, message):
    with pytest.raises((RefusedError, ValueError), match=message):
        equations_of(ARCHIVE.replace(old, new, 1).splitlines())
