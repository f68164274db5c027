"""Reader for models in files from other programs: matrices, names of their degrees of freedom, and the mesh.

==============  ===========================================================  =======================
program         stiffness and mass                                           mesh
==============  ===========================================================  =======================
CalculiX        ``job.sti``, with ``job.mas`` and ``job.dof`` beside it      ``job.inp``
Abaqus          ``job_STIF1.mtx`` and ``job_MASS1.mtx``                      ``job.inp``
Ansys           ``file.full``                                                ``.cdb`` or ``.rst``
Nastran         OP4, ``.op4``; DMIG in ``.pch`` or the bulk data             ``.bdf``, ``.dat``, ``.nas``
MYSTRAN         OP4, ``.OU1`` to ``.OU7``                                    ``.bdf``, ``.dat``, ``.nas``
MATLAB          K and M in a ``.mat`` or ``.m`` file, or in two files
any other       two files for `fmu.formats.matrices.read`, and row names
==============  ===========================================================  =======================

Each line of a separate file with row names is ``node,direction``. The direction is x, y, z, rx, ry, rz or 1 to 6.
The matrices keep the units of the program: fmu does not convert them, and assumes that they are SI units.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

from fmu.arguments import ArgumentError, check_arguments
from fmu.formats.calculix_dat import read_displacements, read_frequencies
from fmu.formats.files import too_large, why_no_file
from fmu.formats.matrices.limits import LARGEST_FILE, MOST_DOFS, Motions, RefusedError, SeveralError, text_lines
from fmu.formats.matrices.nastran.includes import BULK_DATA, included_files
from fmu.formats.matrices.read import read_labelled
from fmu.formats.models import FORMATS
from fmu.formats.models.assembly import assemble
from fmu.formats.models.exported import NO_MESH, DofName, ExportedModel, Mesh
from fmu.formats.models.inp import TRANSFORMED
from fmu.formats.models.ties import tied_motions
from fmu.formats.shown import names_shown, one_line, quote
from fmu.types import DIRECTIONS

_DIRECTION = {d: d for d in DIRECTIONS} | {str(k): d for k, d in enumerate(DIRECTIONS, 1)}
INCLUDING = (*BULK_DATA, ".pch", ".dmig")
_INITIALS = (("K", "M"), ("k", "m"))
_FORMAT_OF = {suffix: form for form in FORMATS for suffix in form.suffixes}
MESHES = tuple(_FORMAT_OF)
"""File suffixes of formats with nodes and elements."""


@check_arguments
def read_model(
    path: str | Path,
    mass: str | Path | None = None,
    mesh: str | Path | Mesh | None = None,
    dofs: str | Path | None = None,
    variables: tuple[str, str] | None = None,
    tied_modes: str | Path | None = None,
) -> ExportedModel:
    """Read a model exported by another program: stiffness, mass, names of the degrees of freedom, and mesh.

    Parameters
    ----------
    path : path
        File with the stiffness, or with both matrices.
    mass : path, optional
        File with the mass, if it is not in `path`. Defaults to the file that the program writes next to the
        stiffness: ``job.mas`` for ``job.sti``, ``job_MASS1.mtx`` for ``job_STIF1.mtx``.
    mesh : path or Mesh, optional
        Nodes and elements. Needed to name the rows of Nastran's OP4, unless `dofs` names them, and to rotate
        matrices from the local axes of nodes to global axes.
    dofs : path, optional
        File with the row names, one ``node,direction`` per line, if the matrices have no names.
    variables : tuple of str, optional
        Names of the stiffness and mass matrices in files with several matrices. If one file has both, they default
        to ``K…`` and ``M…`` with the same ending, or ``stiffness`` and ``mass``.
    tied_modes : path, optional
        ``job.dat`` of CalculiX, with modes of the same model at all nodes (``*NODE PRINT`` with U, and with
        ``GLOBAL=YES`` if the deck has ``*TRANSFORM``). They give the displacements of the nodes that have no rows
        because of ``*TIE``, so that sensors can be placed there. Requires `mesh`.

    Returns
    -------
    ExportedModel
        The model. Rows are removed if they have neither stiffness nor mass, if Abaqus marks them as fixed, or if
        the mesh's constraints and supports eliminate them. The degrees of freedom are along global axes, except at
        the nodes listed in a note. These nodes keep their local axes, and some of their degrees of freedom have no
        row.

    Raises
    ------
    ValueError
        If a file does not exist, is broken, has an unknown format or belongs to another model; if an argument is
        missing, such as `mass` when `path` has one matrix, or `dofs` when nothing else names the rows; or if an
        argument does not apply, such as `dofs` when the matrices have row names. The message begins with the
        argument at fault: ``path:``, ``mass:``, ``mesh:``, ``dofs:`` or ``tied_modes:``.
    """
    path = Path(path)
    found = NO_MESH if mesh is None else mesh
    if not isinstance(found, Mesh):
        found = _name_argument("mesh", partial(_mesh_of, Path(found)))
    beside = _mass_beside(path) if mass is None else Path(mass)
    names: tuple[str | None, str | None]
    if beside is None:
        names = variables if variables is not None else _name_argument("path", partial(_both, path))
        where, files = ("path", "path"), (path, path)
    else:
        names = variables if variables is not None else (None, None)
        where, files = ("path", "mass"), (path, beside)
    matrices = zip(where, files, names, strict=True)
    read = [_name_argument(at, partial(read_labelled, file, name, fill=True)) for at, file, name in matrices]
    if dofs is not None:
        given = _name_argument("dofs", partial(read_names, Path(dofs)))
        for one in read:
            if one.dofs is not None:
                raise ArgumentError("dofs", "must not be given: the matrices name their degrees of freedom")
            if one.matrix.shape[0] != len(given):
                raise ArgumentError("dofs", f"must name {one.matrix.shape[0]} degrees of freedom", len(given))
        read = [one._replace(dofs=given) for one in read]
    model = assemble(read, 1, where, found)
    if mesh is not None:
        require_nodes(model.dofs, model.motions, found, [path])
    motions, notes = dict(model.motions), [*model.notes, *found.notes]
    if tied_modes is not None:
        ties, of_ties = _name_argument(
            "tied_modes", partial(read_ties, Path(tied_modes), found, model.dofs, motions)
        )
        motions, notes = motions | ties, notes + of_ties
    K, M = model.matrices
    mesh_parts = (found.nodes, found.coordinates, found.elements, found.kinds)
    return ExportedModel(K, M, tuple(model.dofs), *mesh_parts, tuple(notes), motions, model.rows)


def read_ties(
    path: Path, mesh: Mesh, dofs: Collection[DofName], known: Motions
) -> tuple[dict[DofName, dict[DofName, float]], list[str]]:
    """Return the displacements of tied nodes, found from CalculiX's printed modes, and a list of notes.

    `tied_motions` describes both results, and `known`.

    Raises
    ------
    ValueError
        If there is no mesh; if the file does not exist, is too large or broken, or has no modes; or if no node is
        tied.
    """
    if mesh is NO_MESH:
        raise ValueError("needs a mesh: the weights of tied nodes come from the elements' faces")
    _require_file(path)
    return tied_motions(mesh, frozenset(dofs), read_displacements(path, len(read_frequencies(path))), known)


@check_arguments
def read_mesh(path: str | Path) -> Mesh:
    """Read the nodes and elements of a model.

    Parameters
    ----------
    path : path
        ``.inp`` (CalculiX, Abaqus), ``.cdb`` or ``.rst`` (Ansys), or ``.bdf``, ``.dat`` or ``.nas`` (Nastran).

    Returns
    -------
    Mesh
        Nodes, elements, constraints and supports; the coordinates are along global axes, in the file's unit.

    Raises
    ------
    ValueError
        If the file does not exist, has an unknown format, is broken or is too large.
    """
    return _name_argument("path", partial(_mesh_of, Path(path)))


def _mesh_of(path: Path) -> Mesh:
    suffix = path.suffix.lower()
    if suffix not in _FORMAT_OF:
        raise ValueError(f"must end in {', '.join(MESHES)} (got {path.name!r})")
    _require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _FORMAT_OF[suffix].read(path)
    except RefusedError as refused:
        raise ValueError(one_line(f"{path.name}: {refused}")) from None
    except MemoryError:
        raise
    except (ValueError, OSError) as error:
        raise ValueError(one_line(f"must hold a mesh ({path.name}: {error})")) from error
    except Exception as error:  # whatever else a broken file makes the readers raise
        raise ValueError(
            one_line(f"must hold a mesh ({path.name}: it is not as such a file has to be)")
        ) from error


def read_names(path: Path) -> tuple[DofName, ...]:
    """Read row names, one ``node,direction`` per line.

    Blanks or semicolons may replace commas. A title in the first line and text after # are skipped.

    Raises
    ------
    ValueError
        If the file does not exist or is too long, or a line does not name a node and one of the directions x, y,
        z, rx, ry, rz or 1 to 6.
    """
    _require_file(path)
    names: list[DofName] = []
    with open(path, "rb") as file:
        for number, line in enumerate(text_lines(file), 1):
            words = line.split("#")[0].replace(",", " ").replace(";", " ").lower().split()
            if not words or (number == 1 and not words[0].isdecimal()):
                continue
            is_name = len(words) == 2 and words[0].isdecimal() and len(words[0]) <= 10
            direction = _DIRECTION.get(words[-1])
            if not is_name or direction is None:
                rule = "must be node,direction with a direction x, y, z, rx, ry, rz or 1 to 6"
                raise ArgumentError(path.name, f"line {number} {rule}", quote(line))
            names.append((int(words[0]), direction))
            if len(names) > MOST_DOFS:
                raise ArgumentError(path.name, f"must have at most {MOST_DOFS} lines")
    return tuple(names)


def require_nodes(
    dofs: Sequence[DofName], motions: Collection[DofName], mesh: Mesh, files: Collection[Path] = ()
) -> None:
    """Raise ValueError if the mesh shares no node with the matrices, or uses *TRANSFORM with Abaqus matrices."""
    if TRANSFORMED in mesh.notes and any(file.suffix.lower() == ".mtx" for file in files):
        raise ArgumentError("mesh", "must have no *TRANSFORM: Abaqus writes matrices along the axes that it turns")
    known = set(mesh.nodes.tolist())
    named = [node for node, _ in motions] + [node for node, _ in dofs]
    if not known.intersection(named):
        raise ArgumentError(
            "mesh", f"must have the nodes of the matrices, such as {named[0]} (it has none of them)"
        )


def _both(path: Path) -> tuple[str, str]:
    """Return the names of the stiffness and mass matrices in a file with several matrices.

    Raise ValueError if the file cannot be read or has only one matrix, or the names do not form exactly one pair.
    """
    try:
        read_labelled(path)
    except ValueError as error:
        if not isinstance(error.__cause__, SeveralError):
            raise
        names = error.__cause__.names
        pairs = [(K, M) for K in names for M in names if _is_pair(K, M)]
        if len(pairs) == 1:
            return pairs[0]
        rule = (
            "must name stiffness and mass (variables)"
            if pairs
            else "must have K and M (or name them in variables)"
        )
        raise ValueError(f"{path.name} {rule}, it has {names_shown(names)}") from None
    raise ValueError(f"{path.name} holds one matrix: give the other as mass")


def read_beside(path: Path) -> list[Path]:
    """Return the files that are read together with `path` although the problem file does not name them.

    For CalculiX, these are the mass matrix, the row names and the list of expanded nodes; for Abaqus, the mass
    matrix. They need not exist. For Nastran, they are the files that a deck includes, or none if the deck cannot
    be read. For other programs, there are none.
    """
    if path.suffix.lower() in INCLUDING:
        try:
            return included_files(path)
        except (OSError, ValueError, RefusedError):  # the file of another program with the same suffix
            return []
    mass = _mass_beside(path)
    names = [path.with_suffix(end) for end in (".dof", ".12d")] if path.suffix.lower() in (".sti", ".mas") else []
    return [*([] if mass is None else [mass]), *names]


def _is_pair(K: str, M: str) -> bool:
    """Return True if two matrix names belong together.

    Examples are ``K`` and ``M``, ``model.Kaa`` and ``model.Maa``, and ``stiffness`` and ``mass``.
    """
    rest = [re.split(r"[./]", name) for name in (K, M)]
    if rest[0][:-1] != rest[1][:-1]:
        return False
    K, M = rest[0][-1], rest[1][-1]
    if (K.lower(), M.lower()) == ("stiffness", "mass"):
        return True
    return (K[:1], M[:1]) in _INITIALS and K[1:] == M[1:]


def _mass_beside(path: Path) -> Path | None:
    """Return the mass file that CalculiX or Abaqus writes next to the stiffness file, or None for other files."""
    if path.suffix.lower() == ".sti":
        return path.with_suffix(".mas")
    if path.suffix.lower() == ".mtx" and "_STIF" in path.name:
        return path.with_name(path.name.replace("_STIF", "_MASS"))
    return None


def _require_file(path: Path) -> None:
    why = why_no_file(path)
    if why:
        raise ValueError(f"must be a file ({why})")
    if too_large(path, LARGEST_FILE):
        raise ValueError(too_large(path, LARGEST_FILE))


def _name_argument[Read](argument: str, read: Callable[[], Read]) -> Read:
    """Return the result of `read`. If `read` raises a ValueError, name `argument` as the argument at fault."""
    try:
        return read()
    except ValueError as error:
        text = str(ArgumentError.of(error).replace_key("variable", ""))
        raise ArgumentError(argument, one_line(text)) from error
