import errno
import os

import pytest

from fmu.durable_files import DamagedError, add_checksum, digest, payload_of, write_durably

TITLE = "fmu test 1"


def test_what_is_written_is_there(tmp_path):
    path = tmp_path / "file"
    for content in (b"one", b"another, longer one", b""):
        write_durably(path, content)
        assert path.read_bytes() == content
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch, call, error):
    path = tmp_path / "file"
    write_durably(path, b"old")

    def fail(*arguments):
        raise error

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(type(error)):
        write_durably(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_content_is_on_disk_before_its_name(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        true = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, name=name, true=true: (calls.append(name), true(*a))[1])
    write_durably(tmp_path / "file", b"content")
    monkeypatch.undo()  # what is said of a failure may itself write files
    assert calls == ["fsync", "replace", "fsync"]  # the content, the name, the directory that holds the name


def test_no_directory(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_durably(tmp_path / "none" / "file", b"content")


@pytest.mark.parametrize("payload", [b"", b"x", bytes(range(256)), b"\n\n" * 10])
def test_signed_content_comes_back(payload):
    assert payload_of(TITLE, add_checksum(TITLE, payload)) == payload
    assert add_checksum(TITLE, payload).split(b"\n")[1].decode() == digest(payload)


def test_every_damaged_byte_is_found():
    """But for the line break after the checksum, of which nothing depends."""
    payload = b"some payload"
    content = add_checksum(TITLE, payload)
    unfound = []
    for i in range(len(content)):
        for flipped in (content[i] ^ 1, content[i] ^ 0x80, 0):
            damaged = content[:i] + bytes([flipped]) + content[i + 1 :]
            if damaged == content:
                continue
            try:
                assert payload_of(TITLE, damaged) == payload
                unfound.append(i)
            except DamagedError:
                pass
    assert set(unfound) <= {len(TITLE) + 1 + 64}


def test_every_torn_file_is_found():
    content = add_checksum(TITLE, b"some payload")
    for length in range(len(content)):
        with pytest.raises(DamagedError):
            payload_of(TITLE, content[:length])
    with pytest.raises(DamagedError, match="its checksum is wrong"):
        payload_of(TITLE, content + b"\0")


def test_another_kind_of_file_is_named():
    with pytest.raises(DamagedError, match="it does not begin with 'fmu test 1'"):
        payload_of(TITLE, add_checksum("fmu test 2", b"some payload"))
