"""Problem files changed at random: their structure, types, values, bytes, references and size.

Each file follows from a seed and its number, so that a sample is part of the whole and any one can be made again.
"""

from __future__ import annotations

import gzip
import os
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.validation.hostile_bases import PROBLEM, bases, put

SEED = 20_240_613


class Hostile(NamedTuple):
    """A file to be checked: of what kind it is, and what writes it, with its neighbours, into an empty folder."""

    name: str
    write: Callable[[Path], object]


NASTY = (
    '""', "0", "-1", "-0.0", "1e400", "1e308", "1e-308", "5e-324", "1e59", "1e61", "nan", "inf", "-inf", "true", "[]",
    "{}", '"x"', "[[]]", "[0.0]", "[nan, inf]", "[1, true, \"x\"]", "{ a = 1 }", "[{}]", "1979-05-27", "07:32:00",
    "1979-05-27T07:32:00Z", '"\\u0000"', '"\\u001b[31m"', '"<b>&"', "9" * 5000, "0x" + "f" * 5000, "99999999",
    "9223372036854775808", "-9223372036854775809", '"../../x.mtx"', '"/dev/zero"', '"."', '"/"', '"é"', '"e\\u0301"',
    "[" * 400 + "]" * 400, "[" * 5000 + "]" * 5000, '"' + "x" * 100_000 + '"', "[" + "1.0, " * 20_000 + "]", "1_000",
    "'''a\nb'''", '"\\u202e"', '"\\U0010ffff"', "0b1", "0o7", "+1", "1.", ".5", "",
)  # fmt: skip
"""What stands in for a value; some of it is no TOML."""
_VALUES = re.compile(r"(?m)^[^#\n\[]*?= *([^#\n]+?) *(?:#.*)?$")
_ATOMS = re.compile(r'"[^"\n]*"|(?<![\w"-])[+-]?\d[\d_]*(?:\.\d+)?(?:[eE][+-]?\d+)?(?![\w"-])')
_NUMBERS = re.compile(r'(?<![\w"-])[+-]?\d[\d_]*(?:\.\d+)?(?:[eE][+-]?\d+)?(?![\w"-])')
_STRINGS = re.compile(r'"[^"\n]*"')
_KEYS = re.compile(r"(?m)^([\w-]+) *=")
_HEADERS = re.compile(r"(?m)^\[+[^\n]*\]+$")


def _spans(pattern: re.Pattern[str], text: str) -> list[tuple[int, int]]:
    """Return where a pattern is in the text, comments left out."""
    group = 1 if pattern.groups else 0
    return [
        m.span(group)
        for m in pattern.finditer(text)
        if "#" not in text[text.rfind("\n", 0, m.start()) + 1 : m.start()]
    ]


def _replaced(text: str, span: tuple[int, int], by: str) -> str:
    return text[: span[0]] + by + text[span[1] :]


def _one(rng: np.random.Generator, items: object) -> object:
    return items[int(rng.integers(len(items)))]  # type: ignore[index,arg-type]


def value(rng: np.random.Generator, text: str) -> str:
    """Replace a value, or a number or a string within one."""
    pattern = _VALUES if rng.random() < 0.5 else _ATOMS
    return _replaced(text, _one(rng, _spans(pattern, text)), str(_one(rng, NASTY)))


def number(rng: np.random.Generator, text: str) -> str:
    """Change numbers by powers of ten, or their signs."""
    for _ in range(int(rng.integers(1, 4))):
        first, last = _one(rng, _spans(_NUMBERS, text))
        old = text[first:last]
        by = [f"-{old.lstrip('+-')}", "0.0", "1e-30", "1e30", f"{float(old) * 10.0 ** rng.integers(-12, 13)!r}"]
        text = _replaced(text, (first, last), str(_one(rng, by)))
    return text


def swap(rng: np.random.Generator, text: str) -> str:
    """Exchange two values, or two strings."""
    places = _spans(_VALUES if rng.random() < 0.5 else _STRINGS, text)
    (a, b), (c, d) = sorted(places[i] for i in rng.choice(len(places), 2, replace=False))
    return text[:a] + text[c:d] + text[b:c] + text[a:b] + text[d:]


def lines(rng: np.random.Generator, text: str) -> str:
    """Drop lines, repeat them, or move them elsewhere."""
    rows = text.splitlines(keepends=True)
    for _ in range(int(rng.integers(1, 4))):
        k, n = int(rng.integers(len(rows))), int(rng.integers(1, 9))
        block, how = rows[k : k + n], int(rng.integers(3))
        rows[k : k + n] = block * 2 if how == 1 else []
        if how == 2:
            at = int(rng.integers(len(rows) + 1))
            rows[at:at] = block
        rows = rows or ["\n"]
    return "".join(rows)


def key(rng: np.random.Generator, text: str) -> str:
    """Rename, quote, dot or repeat a key."""
    span = _one(rng, _spans(_KEYS, text))
    old = text[slice(*span)]
    by = [
        f"{old}s",
        old.upper(),
        f'"{old}"',
        f"{old}.{old}",
        f"{old} = 1\n{old}",
        '""',
        f'"{old}\\u0000"',
        f"{old}é",
    ]
    return _replaced(text, span, str(_one(rng, by)))


def header(rng: np.random.Generator, text: str) -> str:
    """Change the header of a table: its kind, its depth, its place."""
    span = _one(rng, _spans(_HEADERS, text))
    old = text[slice(*span)]
    inner = old.strip("[]")
    by = [
        f"[[{inner}]]",
        f"[{inner}]",
        f"[{inner}.{inner}]",
        f"[[{inner}.x]]",
        "",
        f"{old}\n{old}",
        '[""]',
        "[a]",
        f"[[{inner}]",
    ]
    return _replaced(text, span, str(_one(rng, by)))


def reference(rng: np.random.Generator, text: str) -> str:
    """Let a name refer to another thing, or to none; composed and decomposed characters differ."""
    places = _spans(_STRINGS, text)
    span, other = _one(rng, places), _one(rng, places)
    old = text[slice(*span)]
    accented = unicodedata.normalize(str(_one(rng, ["NFC", "NFD"])), old[:-1] + 'é"')
    by = [text[slice(*other)], old[:-1] + ' "', old.upper(), accented, '"all"', '"none"', old[:-1] + '\\u00a0"']
    return _replaced(text, span, str(_one(rng, by)))


def nested(rng: np.random.Generator, text: str) -> str:
    """Nest keys, tables or arrays deeply."""
    deep = int(_one(rng, [20, 100, 500, 1000, 3000]))
    dotted = ".".join(["a"] * deep)
    where = str(_one(rng, ["", "[model]\n", "[measurement]\n", "[[parameters]]\n"]))
    what = [
        f"{dotted} = 1", f"[{dotted}]\nx = 1", f"[[{dotted}]]\nx = 1", f"prior = {{ {dotted} = 1 }}",
        f"x = {'[' * deep}{']' * deep}", f"x = {'{ a = ' * deep}1{' }' * deep}", "\n".join(f"[{'.'.join(['b'] * k)}]" for k in range(1, deep, 20)),
        f"prior.{dotted} = 1", f"model.{dotted} = 1",
    ]  # fmt: skip
    line = str(_one(rng, what)) + "\n"
    return text.replace(where, where + line, 1) if where and where in text else line + text


def much(rng: np.random.Generator, text: str) -> str:
    """Make a great many mistakes, or a great deal of anything."""
    n = int(_one(rng, [1000, 10_000, 60_000]))
    many = [
        "\n".join(f"unknown{i} = {i}" for i in range(n)) + "\n" + text,
        text + "\n" + '[[parameters]]\nname = "p"\nstart = "x"\n' * (n // 2),
        text + "\n" + '[[noise]]\nname = "p"\nstart = -1\n' * (n // 2),
        text + "\n" + "[[error]]\n" * n,
        text + "\n" + '[[model.members]]\nfrom = "nowhere"\nto = "there"\ngroup = "g"\nsection = "s"\nmaterial = "m"\n' * (n // 10),
        text + "\n" + "\n".join(f"[model.points.p{i}]" for i in range(n // 2)),
        text + "\n[model.points]\n" + "\n".join(f"q{i} = [0.0, 0.0, {i}.0]" for i in range(n)),
        text.replace("[model.points]\n", "[model.points]\n" + "\n".join(f"q{i} = [0.0, 0.0, {i}.0]" for i in range(n)) + "\n"),
        text + "\n" + "[[model.stiffness]]\nmatrix = [[1.0]]\n" * (n // 4),
        text + "\n" + '[[model.masses]]\npoint = "nowhere"\nmass = 1.0\n' * (n // 4),
        re.sub(r"(?m)^frequencies = .*$", "frequencies = [" + "1.0, " * n + "]", text),
        re.sub(r"(?m)^frequencies = .*$", "frequencies = [" + "-1.0, " * n + "]", text),
        re.sub(r"(?m)^sensors = .*$", "sensors = [" + '["x", "y"], ' * n + "]", text),
        re.sub(r"(?m)^sd = .*$", "sd = [" + '"x", ' * n + "]", text),
        re.sub(r"(?m)^frequencies = .*$", "tests = [" + "[1.0, nan], " * n + "]", text),
        text.replace("name = ", f'name = "{"x" * n}"\nold = ', 1),
        f'"{"k" * n * 10}" = 1\n' + text,
        "# " + "c" * n * 100 + "\n" + text,
        text.replace("powers = {", "powers = {" + ", ".join(f"p{i} = 1" for i in range(n)) + ",", 1),
        text + "\n" * n * 10,
    ]  # fmt: skip
    return str(_one(rng, many))


def other_bytes(rng: np.random.Generator, content: bytes) -> bytes:
    """Change, lose or add bytes; encode otherwise."""
    k, n = int(rng.integers(len(content) + 1)), int(rng.integers(41))
    noise = rng.integers(0, 256, int(rng.integers(21)), dtype=np.uint8).tobytes()
    flipped = bytearray(content)
    for at in rng.integers(0, max(len(content), 1), 5) if content else ():
        flipped[at] ^= 1 << int(rng.integers(8))
    text = content.decode("utf-8", "replace")
    ways = [
        lambda: content[:k] + noise + content[k + n :],
        lambda: content[:k],
        lambda: bytes(flipped),
        lambda: b"\xef\xbb\xbf" + content,
        lambda: text.encode("utf-16"),
        lambda: text.encode("utf-32"),
        lambda: text.encode("latin-1", "replace") + b"# \xe9\n",
        lambda: content.replace(b"\n", b"\r\n"),
        lambda: content.replace(b"\n", b"\r"),
        lambda: content[:k] + bytes(n) + content[k:],
        lambda: gzip.compress(content, mtime=0),
        lambda: b"",
        lambda: b"\n \t\n",
        lambda: content + content,
        lambda: content[k:] + content[:k],
        lambda: content[:k] + b"\x1a" + content[k:],
        lambda: content[:k] + b"\xed\xa0\x80" + content[k:],
    ]
    return bytes(ways[int(rng.integers(len(ways)))]())


def other_file(rng: np.random.Generator, path: Path) -> str:
    """Put something else in the place of a file, and say what."""
    content = path.read_bytes()
    path.unlink()
    what = str(
        _one(
            rng,
            [
                "directory",
                "pipe",
                "zero",
                "random",
                "loop",
                "dangling",
                "nothing",
                "closed",
                "link",
                "null",
                "itself",
                "sparse",
            ],
        )
    )
    if what == "directory":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    elif what in ("zero", "random", "null"):
        path.symlink_to({"zero": "/dev/zero", "random": "/dev/urandom", "null": "/dev/null"}[what])
    elif what == "loop":
        path.symlink_to(path.name)
    elif what == "dangling":
        path.symlink_to("nowhere")
    elif what == "closed":
        path.write_bytes(content)
        path.chmod(0)
    elif what == "link":
        path.with_name("elsewhere").write_bytes(content)
        path.symlink_to("elsewhere")
    elif what == "itself":
        path.symlink_to(PROBLEM if path.name != PROBLEM else path.parent)
    elif what == "sparse":
        with path.open("wb") as file:
            file.truncate(2**30)
    return what


TEXTS: dict[str, Callable[[np.random.Generator, str], str]] = {
    "value replaced": value, "number changed": number, "values swapped": swap, "lines lost, moved or twice": lines,
    "key changed": key, "header changed": header, "reference changed": reference, "nested deeply": nested,
    "very much of it": much,
}  # fmt: skip
OFTEN = ("value replaced", "number changed", "reference changed", "lines lost, moved or twice", "header changed")
WAYS = (*TEXTS, *OFTEN, "bytes changed", "another file in its place", "two changes")


def problem_file(number: int, folder: Path, seed: int = SEED) -> Hostile:
    """Return the problem file of a number, from 0; `folder` is for what bases are made of."""
    rng = np.random.default_rng([seed, number])
    known = bases(folder)
    name = list(known)[number % len(known)]
    way = WAYS[number // len(known) % len(WAYS)]
    base = known[name]

    def write(into: Path) -> None:
        text = base.text
        for _ in range(2 if way == "two changes" else 1):
            changed = TEXTS.get(OFTEN[int(rng.integers(len(OFTEN)))] if way == "two changes" else way)
            text = text if changed is None else changed(rng, text)
        content = text.encode("utf-8", "replace")
        path = put(into, base, other_bytes(rng, content) if way == "bytes changed" else content)
        if way == "another file in its place":
            beside = sorted(base.beside)
            other_file(rng, path if not beside or rng.random() < 0.3 else into / str(_one(rng, beside)))

    return Hostile(f"{name}: {way}", write)
