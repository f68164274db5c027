"""Identify a saved run by its configuration and the package versions, which determine the draws."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from fmu.analysis.trace.provenance import canonical_json, configuration_hash, versions
from fmu.durable_files import DamagedError, add_checksum, payload_of, write_durably
from fmu.plain_data import list_in, mapping_in

TITLE = "fmu run 1"
FILE = "run"
_DECISIVE = ("fmu", "numpy", "scipy", "emcee")
_SHOWN = 3


@dataclass(frozen=True)
class Identity:
    """A run's configuration, in plain Python types, and the versions of packages that affect its draws."""

    configuration: Mapping[str, Any]
    versions: Mapping[str, str]

    @classmethod
    def of(cls, configuration: Mapping[str, object]) -> Identity:
        """Return the identity of a run with the installed package versions."""
        now = versions()
        return cls(json.loads(canonical_json(configuration)), {name: now[name] for name in _DECISIVE})

    @property
    def hash(self) -> str:
        """SHA-256 hash of the configuration and the versions."""
        return configuration_hash({"configuration": self.configuration, "versions": self.versions})

    def write(self, directory: Path) -> None:
        """Write the identity to the run's directory."""
        payload = canonical_json({"configuration": self.configuration, "versions": self.versions}).encode()
        write_durably(directory / FILE, add_checksum(TITLE, payload))

    @classmethod
    def read(cls, directory: Path) -> Identity | None:
        """Read the identity of the run in a directory.

        Return None if the directory has none; raise DamagedError if it is damaged.
        """
        path = directory / FILE
        if not path.is_file():
            return None
        held = json.loads(payload_of(TITLE, path.read_bytes()))
        return cls(held["configuration"], held["versions"])

    def check(self, directory: Path) -> None:
        """Raise ValueError if the directory contains another run, or the same run with other package versions.

        A missing or damaged identity file is ignored, because every saved state also contains the hash of its run.
        """
        try:
            found = Identity.read(directory)
        except DamagedError:
            return
        if found is None:
            return
        for name in _DECISIVE:
            here, there = self.versions[name], found.versions.get(name)
            if here != there:
                raise ValueError(
                    f"checkpoint: {directory} was written with {name} {there} and can be resumed bit for bit "
                    f"with that version only (installed: {here})"
                )
        differing = list(_differences(found.configuration, self.configuration))
        if differing:
            more = f", and {len(differing) - _SHOWN} more" if len(differing) > _SHOWN else ""
            raise ValueError(
                f"checkpoint: {directory} contains another run: {'; '.join(differing[:_SHOWN])}{more}"
            )


@cache
def arithmetic() -> str:
    """Return a description of the CPU and BLAS types, which affect the last bits of the results."""
    from threadpoolctl import threadpool_info

    blas = (lib for lib in threadpool_info() if lib["user_api"] == "blas")
    kinds = {f"{lib['internal_api']} {lib['version']} for {lib.get('architecture')}" for lib in blas}
    return ", ".join((platform.machine(), *sorted(kinds)))


def _differences(there: object, here: object, where: str = "") -> Iterator[str]:
    """Yield the differences between two configurations as text."""
    before, after = list_in(there), list_in(here)
    tables = mapping_in(there), mapping_in(here)
    if before is not None and after is not None and len(before) == len(after):
        tables = {str(i): x for i, x in enumerate(before)}, {str(i): x for i, x in enumerate(after)}
    if tables[0] is not None and tables[1] is not None:
        for key in dict.fromkeys((*tables[0], *tables[1])):
            both = tables[0].get(key), tables[1].get(key)
            yield from _differences(*both, f"{where}.{key}" if where else str(key))
    elif json.dumps(there) != json.dumps(here):  # as JSON, NaN equals NaN
        yield f"{where} {_short(there)} there, {_short(here)} here"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
