"""Files of measured modes that are broken: tables, universal files, results of an operational modal analysis."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np

from tests.validation.hostile_bases import FREQUENCIES, SHAPES


def tables() -> dict[str, tuple[str, bytes]]:
    """Return tables of frequencies and of shapes: what is wrong -> the file's name and its content."""
    row = "sway,1,2.314,0.01\n"
    frequencies = {
        "cell of 200 kB": FREQUENCIES.replace("sway", "s" * 200_000),
        "cell of 10 MB": FREQUENCIES.replace("2.314", "2" * 10_000_000),
        "quotes that never end": FREQUENCIES.replace("sway", '"sway'),
        "quotes around everything": FREQUENCIES.replace(",", '","').replace("\n", '"\n"'),
        "NUL": FREQUENCIES.replace("sway", "sw\0ay"),
        "number of 5000 digits": FREQUENCIES.replace(",1,2.314", ",1," + "9" * 5000),
        "mode number of 5000 digits": FREQUENCIES.replace(",1,2.314", f",{'9' * 5000},2.314"),
        "NaN": FREQUENCIES.replace("2.314", "nan"),
        "infinite": FREQUENCIES.replace("2.314", "inf"),
        "negative": FREQUENCIES.replace("2.314", "-2.314"),
        "underscores": FREQUENCIES.replace("2.314", "2_3.14"),
        "digits of another script": FREQUENCIES.replace("2.314", "٢.٣١٤"),
        "decimal commas": FREQUENCIES.replace(",", ";").replace(".", ","),
        "names that are numbers": FREQUENCIES.replace("sway", "1"),
        "names twice": FREQUENCIES.replace("second", "sway"),
        "columns twice": FREQUENCIES.replace("number", "mode"),
        "unknown columns": FREQUENCIES.replace("number", "colour"),
        "no header": row * 3,
        "header alone": "mode,number,frequency,sd\n",
        "comments alone": "# mode\n" * 100_000,
        "a hundred thousand wrong rows": FREQUENCIES + "x,y,z,0\n" * 100_000,
        "a hundred thousand short rows": FREQUENCIES + "x\n" * 100_000,
        "a hundred thousand equal rows": "mode,frequency\n" + "a,1.0\n" * 100_000,
        "a hundred thousand modes": "mode,frequency\n" + "".join(f"m{i},1.0\n" for i in range(100_000)),
        "ten million commas": "," * 10_000_000 + "\n" + "," * 10_000_000,
        "a hundred thousand columns": ",".join(f"c{i}" for i in range(100_000)) + "\n1\n",
        "control characters": FREQUENCIES.replace("sway", "\x1b[31m"),
        "nothing": "",
        "line separators": FREQUENCIES.replace("\n", "\u2028"),
        "vertical tabs": FREQUENCIES.replace("\n", "\v"),
    }
    shapes = {
        "shape cell of 200 kB": SHAPES.replace("0.46", "0." + "4" * 200_000),
        "shape that is NaN": SHAPES.replace("0.46", "nan"),
        "shape in no direction": SHAPES.replace(",x,", ",w,"),
        "sensor twice": SHAPES.replace("floor 3", "floor 1"),
        "sensor without a place": SHAPES.replace("floor 3", ""),
        "shapes of other modes": SHAPES.replace("sway", "torsion"),
        "shapes of zero": re.sub(r"-?\d\.\d+|-1", "0", SHAPES),
        "place of 5000 digits": SHAPES.replace("floor 1", "9" * 5000),
        "fifty thousand sensors": SHAPES + "".join(f"p{i},x,1,1,1\n" for i in range(50_000)),
    }
    found = {name: ("modes.csv", text.encode()) for name, text in frequencies.items()}
    found |= {name: ("shapes.csv", text.encode()) for name, text in shapes.items()}
    return found | {
        "UTF-16": ("modes.csv", FREQUENCIES.encode("utf-16")),
        "BOM": ("modes.csv", b"\xef\xbb\xbf" + FREQUENCIES.encode()),
        "bytes that are no text": ("shapes.csv", bytes(range(256)) * 10),
        "carriage returns": ("modes.csv", FREQUENCIES.replace("\n", "\r").encode()),
    }


def universal(content: bytes) -> dict[str, bytes]:
    """Return universal files that are wrong, from a right one."""
    text = content.decode()
    rows = text.splitlines()
    record = next(i for i, line in enumerate(rows) if line.split()[:2] == ["1", "2"])

    def field(i: int, value: Any, line: int = record, width: int = 10) -> str:
        row = rows[line].ljust(width * (i + 1))
        changed = row[: width * i] + f"{value!s:>{width}}" + row[width * (i + 1) :]
        return "\n".join([*rows[:line], changed, *rows[line + 1 :]]) + "\n"

    body = record + 3
    found = {f"data type {value}": field(4, value) for value in (0, 1, 3, 4, 5, 6, -1, "x")}
    found |= {f"{value} values a node": field(5, value) for value in (0, 1, 2, 4, 5, 6, 9999, -3)}
    found |= {f"analysis type {value}": field(1, value) for value in (0, 1, 3, 4, 5, 7, 99)}
    found |= {f"specific data type {value}": field(3, value) for value in (2, 99, "x")}
    found |= {
        f"frequency {value}": field(0, value, record + 2, 13)
        for value in ("nan", "inf", "-1.0", "0.0", "x", "1e999")
    }
    found |= {f"mode number {value}": field(3, value, record + 1) for value in (-1, 0, "9" * 10, "x")}
    found |= {f"node {value}": field(0, value, body) for value in (-1, "1.5", "nan", "9" * 30, "9" * 5000)}
    found |= {f"shape {value}": field(0, value, body + 1, 13) for value in ("nan", "inf", "x", "1e999", "1E+999")}
    nodes = "    -1\n    15\n" + "{}" + "    -1\n"
    many = "".join(f"{i:10d}\n{1.0:13.5e}{0.0:13.5e}{0.0:13.5e}\n" for i in range(200_000))
    return {name: value.encode() for name, value in found.items()} | {
        "a value lost": "\n".join([*rows[: body + 1], rows[body + 1][:26], *rows[body + 2 :]]).encode(),
        "a node lost": "\n".join([*rows[:body], *rows[body + 1 :]]).encode(),
        "no nodes": "\n".join([*rows[:body], "    -1", ""]).encode(),
        "no end": "\n".join(rows[: body + 2]).encode(),
        "header alone": "\n".join(rows[:4]).encode() + b"\n    -1\n",
        "modes twice": content + content,
        "ten thousand datasets": b"    -1\n    55\n    -1\n" * 10_000,
        "million empty datasets": b"    -1\n    -1\n" * 1_000_000,
        "datasets of no type": b"    -1\nxxxxxx\n    -1\n" * 5,
        "nodes without coordinates": content + nodes.format("         1         0         0         0\n").encode(),
        "nodes that are NaN": content + nodes.format(f"{'nan':>10}" * 4 + f"{'nan':>13}" * 3 + "\n").encode(),
        "infinite nodes": content + nodes.format(f"{'inf':>10}" * 4 + f"{'inf':>13}" * 3 + "\n").encode(),
        "nodes in double precision cut short": content
        + b"    -1\n  2411\n         1         1         1        11\n    -1\n",
        "very many nodes": "\n".join(rows[:body]).encode() + b"\n" + many.encode() + b"    -1\n",
        "NUL": bytes(100_000),
        "binary data": content + b"    -1\n    58b     1     2" + bytes(range(256)) * 1000 + b"\n    -1\n",
        "UTF-16": text.encode("utf-16"),
        "carriage returns": text.replace("\n", "\r").encode(),
        "nothing": b"",
        "a long line": "\n".join([*rows[:body], "1" * 10_000_000, *rows[body + 1 :]]).encode(),
    }


def operational() -> dict[str, bytes]:
    """Return results of an operational modal analysis that are wrong."""
    right: dict[str, Any] = {
        "Fn": [2.314, 6.312], "Phi": [[0.46, -0.98], [0.99, 0.91]], "Fn_std": [0.01, 0.02], "Xi": [0.01, 0.01],
    }  # fmt: skip
    changes: dict[str, dict[str, Any]] = {
        "text for frequencies": {"Fn": ["a", "b"]},
        "complex frequencies": {"Fn": [2.0 + 1j, 3.0]},
        "frequencies that are NaN": {"Fn": [np.nan, 3.0]},
        "frequencies of dates": {"Fn": np.array(["2024-01-01"], dtype="M8[D]")},
        "frequencies in a table": {"Fn": np.zeros(2, dtype=[("a", "f8")])},
        "no frequencies": {"Fn": []},
        "one number": {"Fn": 2.0, "Phi": 1.0},
        "shapes of text": {"Phi": [["a", "b"], ["c", "d"]]},
        "shapes of NaN": {"Phi": np.full((2, 2), np.nan)},
        "shapes of zero": {"Phi": np.zeros((2, 2))},
        "shapes of three dimensions": {"Phi": np.ones((2, 2, 2))},
        "shapes out of phase": {"Phi": [[1.0, 1.0], [1j, 1j]]},
        "deviations of text": {"Fn_std": ["a", "b"]},
        "negative deviations": {"Fn_std": [-1.0, 0.0]},
        "too many deviations": {"Fn_std": [1.0] * 9},
        "no shapes": {"Phi": None},
        "infinite everything": {name: np.full(np.shape(part), np.inf) for name, part in right.items()},
        "many frequencies": {"Fn": np.ones(1_000_000), "Phi": np.ones((2, 1_000_000)), "Fn_std": None},
    }
    found = {}
    for name, change in changes.items():
        buffer = io.BytesIO()
        np.savez(buffer, **{key: np.asarray(part) for key, part in (right | change).items() if part is not None})
        found[name] = buffer.getvalue()
    return found
