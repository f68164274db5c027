"""The page of the keys of problem files, from the JSON schema that ``fmu schema`` prints."""

import json

from fmu.config.problem import schema

BOUNDS = {"exclusiveMinimum": "> {}", "minimum": "≥ {}", "exclusiveMaximum": "< {}", "maximum": "≤ {}"}
TYPES = {"integer": "whole number", "boolean": "true or false", "object": "table", "null": "none"}


def page() -> str:
    """Return the page in MyST, a table of keys for every table of the file."""
    whole = schema()
    parts = [
        "# Problem files\n\nThe keys of a problem file in TOML, from the schema that `fmu schema` prints. "
        "Keys with * must be given. [Your own structure](../notebooks/guide/own-structure.md) and "
        "[a model from another program](../notebooks/guide/other-programs.md) show them in use.\n",
        *_table("The file", whole, {}),
    ]
    titles = _titles(whole)
    for name, heading in titles.items():
        parts += _table(heading, whole["$defs"][name], titles)
    return "\n".join(parts)


def _titles(whole: dict) -> dict[str, str]:
    """Return the heading of every definition, by its name: the place where it first stands in a file."""
    found, waiting = {}, [("", whole)]
    while waiting:
        place, at = waiting.pop(0)
        for key, value in at.get("properties", {}).items():
            for name, is_listed in _references(value, False):
                if name in found:
                    continue
                below = f"{place}.{key}".lstrip(".")
                table = whole["$defs"][name]
                kind = next((f' {k} = "{v["const"]}"' for k, v in table["properties"].items() if "const" in v), "")
                found[name] = f"`[[{below}]]{kind}`" if is_listed else f"`[{below}]{kind}`"
                waiting.append((below, table))
    return found


def _references(value, is_listed):
    """Yield the definitions that a value may be, and whether in a list."""
    if isinstance(value, dict):
        if "$ref" in value:
            yield value["$ref"].rsplit("/", 1)[1], is_listed
        for key, part in value.items():
            yield from _references(part, is_listed or key == "items")
    elif isinstance(value, list):
        for part in value:
            yield from _references(part, is_listed)


def _table(heading: str, table: dict, titles: dict[str, str]) -> list[str]:
    """Return the lines of a section on one table."""
    lines = [
        f"\n## {heading}\n",
        _cell(table.get("description", "")),
        "",
        "| key | value | default | |",
        "|---|---|---|---|",
    ]
    required = table.get("required", ())
    for key, value in table["properties"].items():
        default = (
            f"`{json.dumps(value['default'], ensure_ascii=False)}`" if value.get("default") is not None else ""
        )
        star = "\\*" if key in required else ""
        lines.append(
            f"| `{key}`{star} | {_cell(_words(value))} | {_cell(default)} | {_cell(value.get('description', ''))} |"
        )
    return lines


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("[[", "\\[[").replace("*", "\\*")


def _words(value: dict) -> str:
    """Return what a value may be, in words."""
    if "$ref" in value:
        return "table"
    if "const" in value or "enum" in value:
        return ", ".join(f"`{json.dumps(one)}`" for one in value.get("enum", [value.get("const")]))
    either = value.get("oneOf") or value.get("anyOf")
    if either:
        return " or ".join(dict.fromkeys(_words(one) for one in either))
    if value.get("type") == "array":
        return f"list of {_words(value['items']).replace('table', 'tables')}" if "items" in value else "list"
    kind = TYPES.get(value.get("type"), value.get("type", "any value"))
    bounds = [words.format(value[key]) for key, words in BOUNDS.items() if key in value]
    return " ".join([kind, ", ".join(bounds)]).strip()
