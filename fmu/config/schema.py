"""The JSON schema of a configuration file, for editors that complete and check TOML as it is written."""

from __future__ import annotations

from typing import Any

DIALECT = "https://json-schema.org/draft/2020-12/schema"
TITLE = "A Bayesian model-updating problem for fmu"


def schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file.

    Returns
    -------
    dict
        Draft 2020-12. It knows keys, types and ranges; what holds between the tables, such as that a member's
        section exists, only `fmu.load` checks.
    """
    from fmu.config.problem import ProblemFile

    found = _for_toml(ProblemFile.model_json_schema())
    return {"$schema": DIALECT, "title": TITLE} | found


def _for_toml(part: Any) -> Any:
    """Return a schema in the form that editors show best.

    Without null, which TOML does not have, and without pydantic's titles; line breaks in descriptions are removed.
    """
    if isinstance(part, list):
        return [_for_toml(item) for item in part]
    if not isinstance(part, dict):
        return part
    found: dict[str, Any] = {}
    for key, value in part.items():
        if (key, value) == ("default", None) or (key == "title" and isinstance(value, str)):
            continue
        if key == "description" and isinstance(value, str):
            found[key] = " ".join(value.replace("``", "`").split())
        elif key == "anyOf" and {"type": "null"} in value:
            rest = [_for_toml(item) for item in value if item != {"type": "null"}]
            found |= rest[0] if len(rest) == 1 else {"anyOf": rest}
        else:
            found[key] = _for_toml(value)
    return found
