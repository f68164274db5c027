"""Export the problem file with updated start values, and copy the files that it names."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmu.formats.decks import EXPORTED
from fmu.formats.models.read import read_beside
from fmu.numbers import names_in_words
from fmu.plain_data import list_in, mapping_in

_EDITOR = "#:schema"


_FROM_PRIOR = "from the prior: the data did not inform it"


def updated_text(
    text: str, starts: Mapping[str, float], pairing: str | None, about: str, from_prior: Collection[str] = ()
) -> tuple[str, list[str]]:
    """Return a problem file with new start values, and the strings in it that may be file names.

    Every string that contains a dot or a colon may be a file name.

    Parameters
    ----------
    text : str
        The original problem file's content.
    starts : mapping of str to float
        The start value of each parameter and inferred standard deviation, keyed by name, in SI units.
    pairing : str or None
        The pairing to write to the file; None to leave the file's pairing unchanged.
    about : str
        The source of the values, written as a comment at the top.
    from_prior : collection of str
        Parameters that the data did not inform. A comment beside each of their values says so; for parameters in
        inline tables, which cannot contain comments, a comment at the top.
    """
    import tomlkit
    from tomlkit.items import InlineTable

    document, inline = tomlkit.parse(text), list[str]()
    for table in (*document["parameters"], *document.get("noise", ())):
        table["start"] = tomlkit.value(_toml_number(starts[str(table["name"])]))
        if str(table["name"]) not in from_prior:
            continue
        if isinstance(table, InlineTable):
            inline.append(str(table["name"]))
        else:
            trivia = table["start"].trivia
            before = trivia.comment.removeprefix("#").strip()
            trivia.comment = f"# {before}; {_FROM_PRIOR}" if before else f"# {_FROM_PRIOR}"
            trivia.comment_ws = trivia.comment_ws or "  "
    if pairing is not None and document.get("pairing", "shape") != pairing:
        document["pairing"] = pairing
    lines = tomlkit.dumps(document).splitlines(keepends=True)
    at = 1 if lines and lines[0].startswith(_EDITOR) else 0
    of_prior = f"# {names_in_words(inline)}: {_FROM_PRIOR}\n" if inline else ""
    lines.insert(at, f"# {about}\n{of_prior}")
    words = (str(table[key]) for table, key in _strings(document))
    return "".join(lines), [word for word in words if "." in word or ":" in word]


def _module_file(word: str, source: Path) -> str:
    """Return the file in a folder with the module of ``module:function``; the module's name if there is none."""
    module = word.split(":")[0].replace(".", "/")
    return next((f for f in (f"{module}.py", f"{module}/__init__.py") if (source / f).is_file()), module)


def copy_companions(words: Sequence[str], source: Path, target: Path) -> dict[str, str]:
    """Copy the files that a problem file names from `source` to `target`, so that the exported file is complete.

    `words` are the strings in the problem file that may be file names. A word with a colon, such as
    ``package.module:function``, names the file ``package/module.py`` or ``package/module/__init__.py``. Words that
    name no file inside the folder `source` are ignored. Files that are read together with a named file
    (`read_beside`) are copied too.

    Returns
    -------
    dict of str to str
        New names of the copied files whose original names coincide with an exported file, keyed by original name.
    """
    renamed = {}
    for word in dict.fromkeys(words):
        name = _module_file(word, source) if ":" in word else word
        path = Path(name)
        if path.is_absolute() or ".." in path.parts or not (source / name).is_file():
            continue
        kept = f"model-{name}" if name in EXPORTED else name
        if kept != name:
            renamed[name] = kept
        for one in (path, *(file.relative_to(source) for file in read_beside(source / path))):
            if (source / one).is_file():
                copy = target / (kept if one == path else one)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / one, copy)
                if os.access(source / one, os.X_OK):  # a program that the problem runs
                    shutil.copymode(source / one, copy)
    return renamed


def rename(text: str, names: Mapping[str, str]) -> str:
    """Return a problem file's text with its file names replaced. `names` maps old names to new names."""
    import tomlkit

    if not names:
        return text
    document = tomlkit.parse(text)
    for table, key in list(_strings(document)):
        table[key] = names.get(str(table[key]), table[key])
    return tomlkit.dumps(document)


def _strings(part: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the location of every string in a document: the table or array that contains it, and its key there."""
    table = mapping_in(part)
    for key, value in enumerate(list_in(part) or ()) if table is None else table.items():
        if isinstance(value, str):
            yield part, key
        yield from _strings(value)


def _toml_number(value: float) -> str:
    """Format a float so that reading it gives the same value: ``"1.905e+11"``, ``"0.86"``, ``"1.0"``."""
    if value != 0.0 and not 1e-4 <= abs(value) < 1e7:
        return np.format_float_scientific(value, trim="0")
    return repr(float(value)) if math.isfinite(value) else str(value)
