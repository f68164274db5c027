"""Files of FRFs: universal files with units and coordinate systems, text tables, and arrays of three programs."""

import warnings

import h5py
import numpy as np
import pytest
import scipy.io

import fmu
from fmu.formats.frf.arrays import hdf5_arrays, mat_arrays, of_arrays
from fmu.formats.frf.measured_frfs import Wanted
from fmu.formats.modes.measured_modes import ModesError
from tests.oscillators import measured

PAIRS = [(0, 0), (1, 0), (2, 0)]
F = np.linspace(0.5, 50.0, 100)


@pytest.fixture(scope="module")
def data():
    return measured(PAIRS, f=F, coherence=np.full((3, 100), 0.9), averages=8)


def same(found, data, rtol=1e-12):
    np.testing.assert_allclose(found.frequencies_hz, data.frequencies_hz, rtol=rtol)
    np.testing.assert_allclose(found.values, data.values, rtol=rtol, atol=rtol * np.abs(data.values).max())
    assert (found.drives, found.responses, found.kind) == (data.drives, data.responses, data.kind)


# universal files


def function(frfs, i, **changes):
    """Return dataset 58 of an FRF."""
    one = {"type": 58, "func_type": 4, "rsp_node": frfs.responses[i][0] + 1, "rsp_dir": 1, "ref_node": 1,
           "ref_dir": 1, "x": F, "data": np.array(frfs.values[i]), "abscissa_spacing": 1,
           "abscissa_spec_data_type": 18,
           "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13}  # fmt: skip
    return one | changes


def units(length, force):
    return {"type": 164, "units_code": 9, "units_description": "own", "temp_mode": 1, "length": length,
            "force": force, "temp": 1.0, "temp_offset": 0.0}  # fmt: skip


def nodes(system, places, definition=0):
    x, y, z = np.array(places, dtype=float).T
    n = len(places)
    return {"type": 2411, "node_nums": list(range(1, n + 1)), "x": x, "y": y, "z": z, "def_cs": [definition] * n,
            "disp_cs": [system] * n, "color": [1] * n}  # fmt: skip


def system(number, matrix, kind=0):
    return {"type": 2420, "CS_sys_labels": [number], "CS_types": [kind], "CS_colors": [1], "CS_names": ["own"],
            "CS_matrices": [np.array(matrix, dtype=float)]}  # fmt: skip


def written(path, sets):
    pyuff = pytest.importorskip("pyuff")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")
    return path


NUMBERED = {1: 0, 2: 1, 3: 2}


@pytest.mark.parametrize("change", [{}, {"abscissa_spacing": 0}, {"binary": 1}], ids=["even", "uneven", "binary"])
def test_a_universal_file(data, tmp_path, change):
    sets = [function(data, i, **change) for i in range(3)]
    coherences = [function(data, i, func_type=6, data=np.full(100, 0.9), **change) for i in range(3)]
    path = written(tmp_path / "a.uff", [units(1.0, 1.0), *sets, *coherences])
    found = fmu.read_frf(path, nodes=NUMBERED, averages=8)
    same(found, data, 3e-5 if change == {"abscissa_spacing": 0} else 1e-6)
    np.testing.assert_allclose(found.standard_deviation, data.standard_deviation, rtol=1e-4)
    assert found.notes == ()
    some = fmu.read_frf(path, nodes={1: 0, 3: 2}, frfs=[3, 1], band=(5.0, 20.0))
    assert some.responses == ((2, "x"), (0, "x"))
    assert not some.used[:, 0].any()
    assert [note for note in some.notes if "coherences" in note]
    assert fmu.read_frf(path, frfs=[2]).labels == ("2 x / 1 x",)


def test_units_of_a_universal_file(data, tmp_path):
    """In mm and kN: 1 m is 1000 units, 1 N is 0.001 units."""
    path = tmp_path / "a.uff"
    rows = [data.values[i] * factor for i, factor in enumerate((1e6, 1e3, 1e3))]
    directions = ({}, {"rsp_dir": -5}, {"ref_dir": 6})
    turns = [function(data, i, data=rows[i], **directions[i]) for i in range(3)]
    found = fmu.read_frf(written(path, [units(1000.0, 0.001), *turns]))
    np.testing.assert_allclose(found.values, data.values, rtol=1e-6, atol=1e-9)
    assert (found.responses[1], found.drives[2]) == ((2, "-ry"), (1, "rz"))
    plain = fmu.read_frf(written(path, [function(data, 0, ordinate_axis_units_lab="g/N")]), scale=9.80665)
    np.testing.assert_allclose(plain.values, 9.80665 * data.values[:1], rtol=1e-6, atol=1e-9)
    assert [note[:35] for note in plain.notes] == [
        "The file does not say its units (da",
        "The label of the ordinate is 'g/N':",
    ]


@pytest.mark.parametrize("label", ["mm/s^2", "(g)/(N)", "[g]", "g rms", "g_n", "mg", "gal"])
def test_labels_of_a_universal_file_without_units(data, tmp_path, label):
    labels = {"ordinate_axis_units_lab": label, "orddenom_axis_units_lab": "lbf"}
    notes = fmu.read_frf(written(tmp_path / "a.uff", [function(data, 0, **labels)])).notes
    assert notes[0].endswith(
        f" are assumed. The labels are '{label}' per 'lbf': if these are not SI, give a scale."
    )
    assert len(notes) == 1 + (label not in ("mm/s^2", "mg", "gal"))


@pytest.mark.parametrize(
    ("ordinate", "denominator", "kind"),
    [(8, 13, "receptance"), (11, 13, "mobility"), (12, 0, "accelerance"), (13, 8, "dynamic-stiffness")],
)
def test_kinds_of_a_universal_file(data, tmp_path, ordinate, denominator, kind):
    types = {"ordinate_spec_data_type": ordinate, "orddenom_spec_data_type": denominator}
    values = 1.0 / data.values[0] if kind == "dynamic-stiffness" else data.values[0]
    factor = 0.001 if kind == "dynamic-stiffness" else 1000.0
    path = written(tmp_path / "a.uff", [units(1000.0, 1.0), function(data, 0, data=values * factor, **types)])
    found = fmu.read_frf(path)
    assert found.kind == ("receptance" if kind == "dynamic-stiffness" else kind)
    np.testing.assert_allclose(found.values, data.values[:1], rtol=1e-6, atol=1e-9)
    with pytest.raises(ValueError, match=f"kind: must be '{kind}', as the file says"):
        fmu.read_frf(path, kind="mobility" if kind != "mobility" else "receptance")


Z_TO_X = [[0, 0, 1], [1, 0, 0], [0, 1, 0], [5, 6, 7]]
"""The axes x, y, z of the system are the global z, x, y."""


def test_coordinate_systems_of_a_universal_file(data, tmp_path):
    path = tmp_path / "a.uff"
    places = [[2.0, 0, 0], [0, 3.0, 0], [-1.0, 0, 0]]
    rows = [function(data, i, rsp_dir=direction) for i, direction in enumerate((1, -2, 6))]
    found = fmu.read_frf(written(path, [nodes(7, places), system(7, Z_TO_X), *rows]))
    assert [direction for _, direction in found.responses] == ["z", "-x", "ry"]
    assert found.drives == ((1, "z"),) * 3
    cylinder = system(7, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], kind=1)
    found = fmu.read_frf(written(path, [nodes(7, places), cylinder, *(function(data, i) for i in range(3))]))
    assert [direction for _, direction in found.responses] == ["x", "y", "-x"]
    old = nodes(4, [[0, 0, 0]]) | {"type": 15}
    lines = ["    -1", "    18", f"{4:10d}{0:10d}{0:10d}{8:10d}{1:10d}", "own",
             "".join(f"{x:13.5E}" for x in (1, 1, 1, 1, 2, 1)), "".join(f"{x:13.5E}" for x in (1, 2, 2)),
             "    -1", ""]  # fmt: skip
    written(path, [old, function(data, 0, rsp_dir=1, ref_dir=2)])
    path.write_text("\n".join(lines) + path.read_text())  # x is the global y, z the global z
    assert fmu.read_frf(path).labels == ("1 y / 1 -x",)
    undefined = fmu.read_frf(written(path, [nodes(9, places), function(data, 0)]))
    assert "does not define the coordinate systems [9]" in " ".join(undefined.notes)
    tilted = system(7, [[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1], [0, 0, 0]])
    written(path, [nodes(7, places), tilted, function(data, 0)])
    with pytest.raises(ValueError, match=r"axes along global axes \(direction 1 is \(0.8, 0.6, 0\)\)"):
        fmu.read_frf(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"rsp_dir": 0},
            r"node 1 \(response\): must have a direction from ±1 to ±6 \(got 0, a scalar\); give resp",
        ),
        ({"func_type": 1, "data": F}, r"function type 4 \(got types \[1\]\); make FRFs of time records"),
        ({"data": np.abs(F)}, r"complex values \(got amplitudes without a phase\)"),
        ({"ordinate_spec_data_type": 3}, r"per force \(got data types 3 and 13\)"),
        ({"ordinate_spec_data_type": 0}, r"kind: must be given, as the file does not say it"),
    ],
)
def test_universal_files_refused(data, tmp_path, changes, message):
    path = written(tmp_path / "a.uff", [function(data, 0, **changes)])
    with pytest.raises(ValueError, match=message):
        fmu.read_frf(path)


def test_what_a_scalar_direction_needs(data, tmp_path):
    path = written(tmp_path / "a.uff", [function(data, 0, rsp_dir=0)])
    assert fmu.read_frf(path, responses=(("tip", "-z"),)).labels == ("tip -z / 1 x",)
    with pytest.raises(ValueError, match=r"responses: must be 1, one per FRF of the file \(got 2\)"):
        fmu.read_frf(path, responses=((1, "x"), (2, "x")))


def test_other_universal_files_refused(data, tmp_path):
    path = tmp_path / "a.uff"
    short = function(data, 1, x=F[:50], data=data.values[1, :50])
    for sets, message in (
        ([function(data, 0), short], "must have the lines of the first FRF in all of them .*choose some by frfs"),
        (
            [function(data, 0), function(data, 1, ordinate_spec_data_type=8)],
            "one kind .got accelerance, receptance",
        ),
        ([function(data, 0), function(data, 0)], "each pair of response and drive must be there once"),
        ([units(1.0, 1.0), units(2.0, 1.0), function(data, 0)], "the same units"),
        ([units(1.0, 1.0)], "must have FRFs"),
        ([units(-1.0, 1.0), function(data, 0)], "positive unit factors"),
    ):
        with pytest.raises(ValueError, match=message):
            fmu.read_frf(written(path, sets))
    written(path, [function(data, 0)])
    with pytest.raises(ValueError, match=r"frfs: must be numbers from 1 to 1 \(got 2\)"):
        fmu.read_frf(path, frfs=[2])
    with pytest.raises(ValueError, match="nodes: must have the nodes"):
        fmu.read_frf(path, nodes={5: 1})
    text = path.read_text().replace(f"{100:10d}", f"{120:10d}", 1)
    path.write_text(text)
    with pytest.raises(ValueError, match=r"must have 120 values, as its header says \(got 100\)"):
        fmu.read_frf(path)
    text = written(path, [nodes(1, [[1.0, 2.0, 3.0]]), function(data, 0)]).read_text().splitlines()
    path.write_text("\n".join([*text[:3], *text[4:]]))
    with pytest.raises(ValueError, match="dataset 1: must have a number, two coordinate systems and a place"):
        fmu.read_frf(path)
    path.write_text("nothing")
    with pytest.raises(ValueError, match="must be a universal file"):
        fmu.read_frf(path)


# text tables


def table(path, data, *, long, polar, separator=","):
    """Write the FRFs as a table, with their coherence."""
    names = ("amplitude", "phase_deg") if polar else ("re", "im")
    parts = (np.abs, lambda h: np.degrees(np.angle(h))) if polar else (np.real, np.imag)
    points = [tuple(f"{place} {direction}" for place, direction in pair)
              for pair in zip(data.responses, data.drives, strict=True)]  # fmt: skip
    columns = [np.array([part(row) for part in parts] + [np.full(len(row), 0.9)]) for row in data.values]
    rows = []
    if long:
        rows.append(["frequency_hz", "response", "drive", *names, "coherence"])
        rows += [[repr(float(F[k])), *points[i], *map(repr, map(float, columns[i][:, k]))]
                 for k in range(100) for i in range(3)]  # fmt: skip
    else:
        rows.append(["frequency_hz", *(f"{r} / {d} {name}" for r, d in points for name in (*names, "coherence"))])
        rows += [
            [repr(float(F[k])), *(repr(float(x)) for column in columns for x in column[:, k])] for k in range(100)
        ]
    path.write_text("# of a test\n" + "\n".join(separator.join(row) for row in rows))
    return path


def test_an_frf_without_a_standard_deviation_beside_others(data, tmp_path):
    """The sds of all were dropped before some FRFs were chosen, and without a note."""
    rows = [["frequency_hz"], *([repr(float(f))] for f in F)]
    for i, label in enumerate(data.labels):
        parts = {"re": data.values[i].real, "im": data.values[i].imag, "sd": data.standard_deviation[i]}
        for name in list(parts)[: 2 if i == 0 else 3]:
            for row, value in zip(rows, [f"{label} {name}", *parts[name]], strict=True):
                row.append(str(value))
    path = tmp_path / "a.csv"
    path.write_text("\n".join(map(",".join, rows)))
    some = fmu.read_frf(path, kind="accelerance", frfs=[3, 2])
    assert (some.responses, some.notes) == (data.responses[:0:-1], ())
    np.testing.assert_allclose(some.values, data.values[:0:-1], rtol=1e-12)
    np.testing.assert_allclose(some.sd, data.standard_deviation[:0:-1], rtol=1e-12)
    every = fmu.read_frf(path, kind="accelerance")
    assert (every.sd, every.notes) == (None, ("The sd is not used, as only 2 of 3 FRFs have it.",))
    with pytest.raises(ValueError, match="averages: must not be given together with an sd, here or in the file"):
        fmu.read_frf(path, kind="accelerance", frfs=[2], averages=8)


def test_a_coherence_does_not_depend_on_the_sign_of_a_direction(data, tmp_path):
    sets = [function(data, i, rsp_dir=-1) for i in range(2)]
    coherences = [function(data, i, func_type=6, data=np.full(100, 0.9 - 0.1 * i)) for i in range(2)]
    found = fmu.read_frf(written(tmp_path / "a.uff", [units(1.0, 1.0), *sets, *coherences]), averages=8)
    np.testing.assert_allclose(found.coherence, [[0.9] * 100, [0.8] * 100], rtol=1e-6)
    both = [function(data, 0, rsp_dir=sign) for sign in (3, -3)]
    theirs = [function(data, 0, rsp_dir=s, func_type=6, data=np.full(100, c)) for s, c in ((3, 0.9), (-3, 0.5))]
    found = fmu.read_frf(written(tmp_path / "a.uff", [units(1.0, 1.0), *both, *theirs]), averages=8)
    np.testing.assert_allclose(found.coherence[:, 0], [0.9, 0.5], rtol=1e-6)
    some = fmu.read_frf(written(tmp_path / "a.uff", [units(1.0, 1.0), *sets, coherences[0]]))
    assert "The coherence is not used, as only 1 of 2 FRFs have it." in some.notes
    assert some.coherence is None


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize("polar", [False, True])
def test_tables(data, tmp_path, long, polar):
    path = table(tmp_path / "a.csv", data, long=long, polar=polar, separator=";" if polar else ",")
    found = fmu.read_frf(path, kind="accelerance", averages=8)
    same(found, data, 1e-12)
    np.testing.assert_allclose(found.standard_deviation, data.standard_deviation, rtol=1e-10)
    assert fmu.read_frf(path, kind="accelerance", frfs=[3]).labels == data.labels[2:]
    with pytest.raises(ValueError, match="kind: must be given"):
        fmu.read_frf(path)
    with pytest.raises(ValueError, match=r"nodes: must not be given for a .csv file"):
        fmu.read_frf(path, nodes={1: 2}, kind="mobility")


def test_cells_without_a_value(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("frequency_hz,tip -z / 1 x re,tip -z / 1 x im,tip -z / 1 x sd\n1,2,3,0.1\n2,,nan,0.1\n")
    found = fmu.read_frf(path, kind="receptance", scale=2.0)
    assert found.labels == ("tip -z / 1 x",)
    assert found.used.tolist() == [[True, False]]
    assert (found.values[0, 0], found.standard_deviation[0, 0]) == (4.0 + 6.0j, 0.2)
    path.write_text("frequency_hz,response,drive,re,im\n1,a x,b y,1,2\n2,c x,b y,3,4\n")
    found = fmu.read_frf(path, kind="receptance")
    assert found.used.tolist() == [[True, False], [False, True]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("f,a x / b x re\n1,2", "column frequency_hz: is missing .the columns are f, a x / b x re"),
        ("frequency_hz,a x / b x re\n1,2", "columns re and im, or amplitude and phase_deg of a x / b x .got re"),
        ("frequency_hz,a / b re\n1,2", "column a / b re: must be named as"),
        ("frequency_hz\n1", "must have a column per part of an FRF"),
        ("frequency_hz,response,drive,re,im\n1,a,b x,1,2", "line 2, column response: .*such as 'tip -z' .got 'a'"),
        ("frequency_hz,response,drive,re,im\n1,a x,b x,?,2", "line 2, column re: must be a number .got '.'"),
        (
            "frequency_hz;a x / b x re;a x / b x im\n1,5;2;-3,4e-3",
            "line 2, column frequency_hz: .* not a comma .got '1,5'",
        ),
        ("frequency_hz,response,drive,re,im\n,a x,b x,1,2", "line 2, column frequency_hz: must be a number"),
        ("frequency_hz,response,drive,re,im,q\n1,a x,b x,1,2,3", "column q: must be one of re, im, amplitude"),
        ("frequency_hz,response,drive,re,im\n1,a x,b x,1,2\n1,a x,b x,1,2", "line 3: must not repeat a frequency"),
    ],
)
def test_tables_refused(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        fmu.read_frf(path, kind="mobility")


# arrays


def arrays(data, **changes):
    points = {key: np.array([f"{place} {direction}" for place, direction in getattr(data, key)])
              for key in ("drives", "responses")}  # fmt: skip
    return {"frequencies_hz": F, "values": np.array(data.values), "kind": "accelerance", "averages": 8.0,
            "coherence": np.full((3, 100), 0.9), **points} | changes  # fmt: skip


def test_npz(data, tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, **arrays(data))
    found = fmu.read_frf(path)
    same(found, data)
    assert found.standard_deviation.tolist() == data.standard_deviation.tolist()
    np.savez(path, f=F, H=np.array(data.values[0]), drives=np.array([["0", "x"]]))
    found = fmu.read_frf(path, kind="mobility", responses=((5, "y"),))
    assert found.labels == ("5 y / 0 x",)
    np.savez(path, values=np.array([None]), frequencies_hz=F)
    with pytest.raises(ValueError, match="Python objects, which are not read"):
        fmu.read_frf(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"must be an .npz file of numbers and text"):
        fmu.read_frf(path)


def test_modalfrf_of_one_drive(data, tmp_path):
    """SciPy drops the third axis of MATLAB's array, which has the length 1."""
    path, H = tmp_path / "a.mat", np.array(data.values).T[:, :, None]
    scipy.io.savemat(path, {"f": F, "frf": H, "coh": np.full(H.shape, 0.9)})
    found = fmu.read_frf(path, kind="accelerance", drives=data.drives[:1], responses=data.responses, averages=9)
    assert found.drives == data.drives
    np.testing.assert_array_equal(found.values, data.values)


def test_mat(data, tmp_path):
    """A structure of MATLAB with columns of FRFs, and the array of modalfrf."""
    path = tmp_path / "a.mat"
    H = np.array(data.values).T
    test = {"Freq": F[:, None], "H": H, "resp": np.array(["0 x", "1 x", "2 x"], dtype=object)}
    scipy.io.savemat(path, {"test": test, "cube": np.stack([H, 2 * H], axis=2), "f": F, "other": 3.0})
    named = {"frequencies_hz": "test.Freq", "values": "test.H", "responses": "test.resp"}
    found = fmu.read_frf(path, kind="accelerance", variables=named, drives=data.drives)
    same(found, data)
    points = {"responses": data.responses, "drives": ((0, "x"), (9, "y"))}
    content = mat_arrays(path)
    both = of_arrays(path.name, content, Wanted(variables={"values": "cube"}, **points), lines_first=True)
    assert both.responses[:3] == ((0, "x"), (0, "x"), (1, "x"))
    assert both.drives[:2] == ((0, "x"), (9, "y"))
    np.testing.assert_array_equal(both.values[::2], data.values)
    np.testing.assert_array_equal(both.values[1::2], 2 * data.values)
    for variables, message in (
        ({"frequencies": "f"}, r"variables: must be of frequencies_hz, values, .* \(got 'frequencies'\)"),
        ({"values": "G"}, r"variables.values: must be one of .*test.H.* \(got 'G'\)"),
        ({}, r"variables: must name the array of values, none of values, FRF, frf, H is there \(the file has "),
        ({"values": "other"}, r"values: must have shape \(n_frfs, 100\) or \(100, n_frfs\)"),
        ({"values": "test.resp"}, "values: must be numbers"),
        (named, "drives: must be given, the place and the direction of each of the 3 FRFs"),
    ):
        with pytest.raises(ValueError, match=message):
            of_arrays(path.name, content, Wanted(variables=variables), lines_first=True)


def test_hdf5(data, tmp_path):
    """HDF5 with the names of the attributes; and as MATLAB 7.3 writes it, with reversed axes and pairs."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name, array in arrays(data).items():
            text = np.asarray(array).dtype.kind == "U"
            file.create_dataset(name, data=np.asarray(array).astype(object) if text else array,
                                dtype=h5py.string_dtype() if text else None)  # fmt: skip
    same(of_arrays(path.name, hdf5_arrays(path), Wanted(), lines_first=False), data)
    pairs = np.empty((3, 100), dtype=[("real", "f8"), ("imag", "f8")])
    pairs["real"], pairs["imag"] = np.real(data.values), np.imag(data.values)
    with h5py.File(path, "w") as file:
        for name, array, kind in (("t/H", pairs, "double"), ("t/f", F[None], "double"),
                                  ("t/kind", np.array([[*map(ord, "accelerance")]], "u2").T, "char")):  # fmt: skip
            file.create_dataset(name, data=array).attrs["MATLAB_class"] = np.bytes_(kind)
    named = {"frequencies_hz": "t.f", "values": "t.H", "kind": "t.kind"}
    wanted = Wanted(data.drives, data.responses, variables=named)
    same(of_arrays(path.name, hdf5_arrays(path), wanted, lines_first=False), data)
    with h5py.File(path, "a") as file:  # a matrix of text, and a cell array: references to other datasets
        rows = np.array([[*map(ord, "deck ")], [*map(ord, "tower")]], "u2").T
        file.create_dataset("places", data=rows).attrs["MATLAB_class"] = np.bytes_("char")
        file.create_dataset("cells", (1, 2), dtype=h5py.ref_dtype)
    assert hdf5_arrays(path)["places"].tolist() == ["deck", "tower"]
    assert "cells" not in hdf5_arrays(path)
    elsewhere = h5py.VirtualLayout(shape=(1, 100), dtype=float)
    elsewhere[:] = h5py.VirtualSource(str(path), "t/f", shape=(1, 100))
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        file.create_virtual_dataset("f", elsewhere)
        file["own"] = F
    assert list(hdf5_arrays(tmp_path / "virtual.h5")) == ["own"]
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(ValueError, match=r"a.h5: "):
        fmu.read_frf(path, kind="accelerance")


@pytest.mark.parametrize("suffix", [".uff", ".csv", ".npz"])
def test_points_are_of_all_frfs_in_the_file(data, tmp_path, suffix):
    """Also where only some FRFs are read, in another order."""
    path = tmp_path / f"a{suffix}"
    if suffix == ".uff":
        written(path, [units(1.0, 1.0), *(function(data, i) for i in range(3))])
    elif suffix == ".csv":
        table(path, data, long=False, polar=False)
    else:
        np.savez(path, **arrays(data))
    points = {"responses": ((7, "x"), (8, "y"), (9, "z")), "drives": ((4, "x"), (5, "y"), (6, "z"))}
    found = fmu.read_frf(path, kind="accelerance", frfs=[3, 1], **points)
    assert found.labels == ("9 z / 6 z", "7 x / 4 x")
    for key, own in points.items():
        with pytest.raises(ValueError, match=rf"{key}: must be 3, one per FRF of the file \(got 2\)"):
            fmu.read_frf(path, kind="accelerance", frfs=[3, 1], **(points | {key: own[:2]}))
    if suffix == ".uff":
        found = fmu.read_frf(path, nodes={1: 1, 3: 3}, **points)
        assert found.labels == ("7 x / 4 x", "9 z / 6 z")


def test_other_files_refused(tmp_path):
    with pytest.raises(ValueError, match=r"path: must end in .uff, .unv, .* \(got '.xyz'\)"):
        fmu.read_frf(tmp_path / "a.xyz")
    with pytest.raises(FileNotFoundError, match="no such file"):
        fmu.read_frf(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("more", "rule"),
    [
        ({"sd": np.full((2, 100), 0.1)}, r"sd: must have 3 rows, one per FRF \(got 2\)"),
        ({"coherence": np.full(100, 0.9)}, r"coherence: must have 3 rows, one per FRF \(got 1\)"),
        ({"kind": np.array([], dtype=str)}, r"kind: must have a value"),
        ({"averages": np.array([])}, r"averages: must have a value"),
    ],
)
def test_arrays_beside_the_frfs_fit_them(data, more, rule):
    arrays = {"frequencies_hz": F, "values": np.asarray(data.values)} | more
    points = [(i, "x") for i in range(3)]
    with pytest.raises(ModesError, match=rule):
        of_arrays("test.npz", arrays, Wanted(drives=points[:1] * 3, responses=points, frfs=[3]), lines_first=False)
