"""Files that appear complete or not at all, whatever happens, and with a checksum that shows later damage."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

_DIGEST = 64  # hexadecimal figures of SHA-256


class DamagedError(ValueError):
    """A file is not as it was written."""


def write_durably(path: Path, content: bytes | memoryview) -> None:
    """Write a file so that it has its old content or all of its new content, even if the machine stops.

    Raises
    ------
    OSError
        If it cannot be written, because the disk is full for example. The old content stays.
    """
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(unfinished, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
        sync_directory(path.parent)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise


def append_durably(path: Path, content: bytes) -> None:
    """Append to a file, which is made if there is none; a kill can truncate only what is being appended."""
    with open(path, "ab") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def make_directory(path: Path) -> None:
    """Make a directory if there is none, so that it exists even if the machine stops."""
    if not path.is_dir():
        path.mkdir()
        sync_directory(path.parent)


def digest(content: bytes) -> str:
    """Return the SHA-256 of bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def add_checksum(title: str, payload: bytes) -> bytes:
    """Return the content of a file: its title, the checksum of the payload, and the payload."""
    return f"{title}\n{digest(payload)}\n".encode() + payload


def payload_of(title: str, content: bytes) -> bytes:
    """Return the payload of such a content.

    Raises
    ------
    DamagedError
        If the content is not one that `add_checksum` returned with this title.
    """
    head = len(title) + 1
    if content[:head] != f"{title}\n".encode():
        raise DamagedError(f"it does not begin with {title!r}")
    found, payload = content[head : head + _DIGEST], content[head + _DIGEST + 1 :]
    if found.decode("ascii", "replace") != digest(payload):
        raise DamagedError("its checksum is wrong")
    return payload


def sync_directory(directory: Path) -> None:
    """Write the names in a directory to disk, if the system can do that."""
    if os.name == "posix":
        handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
