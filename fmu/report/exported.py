"""Files that carry an updated model back to where it came from: matrices, a problem file with new starts."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.fem.modes.separable import SeparableModel


VALUES, STIFFNESS, MASS, DOFS, PROBLEM = "theta.csv", "K.mtx", "M.mtx", "dofs.csv", "updated.toml"
RESERVED = (VALUES, STIFFNESS, MASS, DOFS, PROBLEM)
_EDITOR = "#:schema"


def write_matrices(
    model: SeparableModel, places: Mapping[str, Any], theta: FloatArray, about: str, folder: Path
) -> None:
    """Write K and M at theta in Matrix Market format, their lower triangles alone, and what their rows are."""
    from scipy.io import mmwrite

    for name, matrix, words in (
        (STIFFNESS, model.K(theta), "Stiffness in N/m; of rotations in N m/rad."),
        (MASS, model.M(theta), "Mass in kg; of rotations in kg m^2."),
    ):
        symmetric = 0.5 * (matrix + matrix.T)
        comment = f" {words} {about} {DOFS} names the rows; entries above the diagonal are omitted."
        with (folder / name).open("wb") as file:  # a name would be taken for ASCII
            mmwrite(file, symmetric.tocoo(), comment=_ascii(comment), precision=17, symmetry="symmetric")
    dof_table(model, places).to_csv(folder / DOFS, index=False)


def dof_table(model: SeparableModel, places: Mapping[str, Any]) -> pd.DataFrame:
    """Return what each row of the matrices is: ``row`` from 1, ``node``, ``place`` if named, ``direction``.

    Where the geometry is known also ``x``, ``y``, ``z`` of the node, m.
    """
    import pandas as pd

    named: dict[Any, str] = {}
    for place, node in places.items():
        named.setdefault(node, str(place))
    nodes = [node for node, _ in model.dofs]
    columns: dict[str, Any] = {
        "row": np.arange(1, len(nodes) + 1),
        "node": nodes,
        "place": [named.get(node, "") for node in nodes],
        "direction": [direction for _, direction in model.dofs],
    }
    if model.geometry is not None:
        coordinates = np.asarray(model.geometry.nodes)
        columns |= {axis: [coordinates[node][i] for node in nodes] for i, axis in enumerate("xyz")}
    return pd.DataFrame(columns)


def updated_text(text: str, starts: Mapping[str, float], pairing: str | None, about: str) -> tuple[str, list[str]]:
    """Return a problem file with new start values, all else as it is, and the files beside it that it may name.

    Parameters
    ----------
    text : str
    starts : mapping of str to float
        By the name of the parameter, SI units.
    pairing : str or None
        To be said in the file, if it says another or none.
    about : str
        Where the values come from: a comment at the top.
    """
    import tomlkit

    document = tomlkit.parse(text)
    for table in (*document["parameters"], *document.get("noise", ())):
        table["start"] = tomlkit.value(_toml_number(starts[str(table["name"])]))
    if pairing is not None and document.get("pairing", "shape") != pairing:
        document["pairing"] = pairing
    lines = tomlkit.dumps(document).splitlines(keepends=True)
    at = 1 if lines and lines[0].startswith(_EDITOR) else 0
    lines.insert(at, f"# {about}\n")
    return "".join(lines), [word for word in _strings(document) if "." in word or ":" in word]


def copy_companions(words: Sequence[str], source: Path, target: Path) -> dict[str, str]:
    """Copy the files beside a problem file that it names, so that the updated one stands by itself.

    Returns
    -------
    dict of str to str
        The new names of files that could not keep theirs, because an exported one has it.
    """
    renamed = {}
    for word in dict.fromkeys(words):
        name = f"{word.split(':')[0]}.py" if ":" in word else word
        path = Path(name)
        if path.is_absolute() or ".." in path.parts or not (source / name).is_file():
            continue
        kept = f"model-{name}" if name in RESERVED else name
        if kept != name:
            renamed[name] = kept
        (target / kept).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, target / kept)
    return renamed


def rename(text: str, names: Mapping[str, str]) -> str:
    """Return a problem file in which files have other names."""
    import tomlkit

    if not names:
        return text
    document = tomlkit.parse(text)
    _replace(document, names)
    return tomlkit.dumps(document)


def _strings(part: Any) -> Iterator[str]:
    """Yield every string of a document."""
    if isinstance(part, str):
        yield str(part)
    elif isinstance(part, Mapping):
        for value in part.values():
            yield from _strings(value)
    elif isinstance(part, list):
        for value in part:
            yield from _strings(value)


def _replace(part: Any, names: Mapping[str, str]) -> None:
    keys = list(part) if isinstance(part, Mapping) else range(len(part))
    for key in keys:
        value = part[key]
        if isinstance(value, str):
            if str(value) in names:
                part[key] = names[str(value)]
        elif isinstance(value, Mapping | list):
            _replace(value, names)


def _toml_number(value: float) -> str:
    """Write a float that comes back as it was: ``"1.905e+11"``, ``"0.86"``, ``"1.0"``."""
    if value != 0.0 and not 1e-4 <= abs(value) < 1e7:
        return np.format_float_scientific(value, trim="0")
    return repr(float(value)) if math.isfinite(value) else str(value)


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()
