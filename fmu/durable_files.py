"""Write files atomically, and detect later damage by checksums."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

_DIGEST = 64  # hexadecimal digits of SHA-256


class DamagedError(ValueError):
    """Raised if a file's content is not as it was written, or if the file cannot be read."""


def write_durably(path: Path, content: bytes | memoryview) -> None:
    """Write a file so that even a power failure leaves either its old or its complete new content.

    Raises
    ------
    OSError
        If the file cannot be written, for example because the disk is full. The old content is then kept.
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
    """Append to a file, which is created if it does not exist.

    If the process is killed or the disk is full, only `content` may be truncated; the earlier content is safe.

    Raises
    ------
    OSError
        If the file cannot be written, for example because the disk is full.
    """
    with open(path, "ab") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def make_directory(path: Path) -> None:
    """Create a directory unless it exists, and make sure that it survives a power failure."""
    if not path.is_dir():
        path.mkdir()
        sync_directory(path.parent)


def digest(content: bytes) -> str:
    """Return the SHA-256 hash of `content` as a hexadecimal string."""
    return hashlib.sha256(content).hexdigest()


def add_checksum(title: str, payload: bytes) -> bytes:
    """Return file content that consists of a title, the checksum of the payload, and the payload."""
    return f"{title}\n{digest(payload)}\n".encode() + payload


def payload_of(title: str, content: bytes) -> bytes:
    """Return the payload of file content that `add_checksum` made.

    Raises
    ------
    DamagedError
        If the content does not begin with `title`, or its checksum is wrong.
    """
    head = len(title) + 1
    if content[:head] != f"{title}\n".encode():
        raise DamagedError(f"it does not begin with {title!r}")
    found, payload = content[head : head + _DIGEST], content[head + _DIGEST + 1 :]
    if found.decode("ascii", "replace") != digest(payload):
        raise DamagedError("its checksum is wrong")
    return payload


def sync_directory(directory: Path) -> None:
    """Flush the entries of a directory to disk on POSIX systems; do nothing on others."""
    if os.name == "posix":
        handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
