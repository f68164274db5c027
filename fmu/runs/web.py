"""Serve a web page that follows a run, for browsers on this machine or at the other end of an SSH tunnel.

Anyone who knows the address may watch and stop the run. The address contains a random token, and every request
without the token is refused. A request whose Host header names another machine is also refused. This protects
against DNS rebinding, in which another site's host name is made to point to this machine.
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import secrets
import signal
import socket
import threading
import time
from contextlib import suppress
from dataclasses import asdict
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

from fmu.progress.words import as_json
from fmu.runs.status import FINISHED, KILLED, RUNNING, STOPPED, RunReader, RunReading
from fmu.runs.words import HEADER, WORDS, rows, state_of, to_resume

LOOPBACK = "127.0.0.1"
_PAGE = Path(__file__).with_name("page.html")
Request = socket.socket | tuple[bytes, socket.socket]
_IDLE_S = 10.0
"""Time in s for which a connection may be silent during a request."""
_PATIENCE = 0.5
"""Longest time in s for which stopping and closing wait for a reading of the directory to end."""


class WatchServer(ThreadingHTTPServer):
    """Server for a run's web page. Failures of the server or its clients never affect the run.

    Parameters
    ----------
    directory : Path
        The run's directory, as for `fmu.runs.status.RunReader`.
    every : float
        Time in s between readings of the directory.
    host : str
        Address at which the server listens.
    port : int
        Port at which the server listens; 0 for any free port.
    most_connections : int
        Largest number of open connections. Further connections are closed.
    request_s : float
        Time limit in s for a request's headers.

    Attributes
    ----------
    address : str
        Address of the page, with the token.
    closing : Event
        Set when no more readings will be sent.

    Raises
    ------
    ValueError
        If the directory contains no run, or the server cannot listen at host and port.
    """

    daemon_threads = True

    def __init__(
        self,
        directory: Path,
        every: float,
        host: str = LOOPBACK,
        port: int = 0,
        *,
        most_connections: int = 32,
        request_s: float = 10.0,
    ) -> None:
        self.every, self.host, self.closing, self.request_s = every, host, threading.Event(), request_s
        self._reader, self._lock, self._read_at = RunReader(directory), threading.Lock(), -float("inf")
        self._reading = self._reader.read()
        self._open = threading.BoundedSemaphore(most_connections)
        self._token = secrets.token_urlsafe(32)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            why = error.strerror or error
            raise ValueError(f"--web: must be able to listen at {host}, port {port} ({why})") from None
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self.server_port}/{self._token}/"

    def reading(self) -> RunReading:
        """Return the run's state, at most `every` seconds old while the server is open.

        Raise ValueError if the directory is gone.
        """
        with self._lock:
            if not self.closing.is_set() and time.monotonic() - self._read_at >= self.every:
                self._reading = self._reader.read()
                self._read_at = time.monotonic()
            return self._reading

    def stop_run(self) -> str:
        """Send SIGTERM to the run's process. Return the reason if this failed, or an empty string.

        The process is taken from a new reading of the directory, or from the last one if another thread is reading
        and does not finish within `_PATIENCE` seconds. Raise ValueError if the directory is gone.
        """
        reading = self._reading
        if self._lock.acquire(timeout=_PATIENCE):
            try:
                reading = self._reading = self._reader.read()
            finally:
                self._lock.release()
        why = why_not_to_stop(reading)
        if not why and reading.at_work is not None:
            try:
                os.kill(reading.at_work.pid, signal.SIGTERM)
            except OSError as error:
                why = f"Process {reading.at_work.pid} could not be stopped: {error.strerror}."
        return why

    def admits(self, host: str | None, path: str) -> bool:
        """Return True if a request's path contains the token and the Host header `host` is accepted."""
        token = path.split("/")[1] if "/" in path else ""
        known = hmac.compare_digest(token.encode("utf-8", "replace"), self._token.encode())
        return known and self._is_own(host or "")

    def _is_own(self, host: str) -> bool:
        """Return True if a Host header's value is an IP address or one of this machine's names."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in ("localhost", self.host.lower(), socket.gethostname().lower())
        return True

    def server_close(self) -> None:
        """Close the server, and end the event streams of all open pages.

        The server waits up to `_PATIENCE` seconds for a reading to end. A thread that Python ends inside HDF5
        would keep the HDF5 lock, and the process would hang.
        """
        self.closing.set()
        waited = self._lock.acquire(timeout=_PATIENCE)
        super().server_close()
        if waited:
            self._lock.release()

    def process_request(self, request: Request, client_address: tuple[str, int]) -> None:
        """Answer a connection in a new thread, or close it if there are too many connections."""
        if self._open.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Request, client_address: tuple[str, int]) -> None:
        """Answer a connection, and then remove it from the count of open connections."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._open.release()

    def finish_request(self, request: Request, client_address: tuple[str, int]) -> None:
        """Answer a request. Ignore the error if the client has closed the connection or is silent for too long."""
        with suppress(ConnectionError, TimeoutError):
            super().finish_request(request, client_address)


def why_not_to_stop(reading: RunReading) -> str:
    """Return a sentence that says why a run cannot be stopped from this machine; empty if it can be stopped."""
    who = reading.at_work
    if who is None or reading.state != RUNNING:
        return "It is not running."
    if who.is_alive() is None:
        return f"It runs on {who.host} and can only be stopped there."
    return ""


def page_content(reading: RunReading) -> dict[str, object]:
    """Return the content of the page as a dict.

    The entry ``reading`` holds the data that ``fmu watch --json`` prints. The other entries hold the same reading
    as text, the table for the page, and the present time in s since 1970.
    """
    return {
        "reading": asdict(reading),
        "runs": reading.state == RUNNING,
        "ended": reading.state in (STOPPED, KILLED, FINISHED),
        "state": state_of(reading),
        "header": HEADER,
        "words": WORDS,
        "rows": rows(reading),
        "verdicts": [(one.name, one.verdict) for one in reading.samplers if one.verdict],
        "to_resume": to_resume(reading),
        "why_not_to_stop": why_not_to_stop(reading),
        "at": time.time(),
    }


class _Handler(BaseHTTPRequestHandler):
    """Handler for one connection."""

    server: WatchServer
    server_version, sys_version = "fmu", ""
    timeout = _IDLE_S

    def setup(self) -> None:
        """Start the time limit after which the connection is closed if its headers are incomplete."""
        super().setup()
        self._deadline = threading.Timer(self.server.request_s, self._close)
        self._deadline.daemon = True
        self._deadline.start()

    def parse_request(self) -> bool:
        """Read the headers, and cancel the time limit."""
        try:
            return super().parse_request()
        finally:
            self._deadline.cancel()

    def finish(self) -> None:
        """Cancel the time limit, and close the connection."""
        self._deadline.cancel()
        super().finish()

    def _close(self) -> None:
        with suppress(OSError):  # the connection is already closed
            self.connection.shutdown(socket.SHUT_RDWR)

    def do_GET(self) -> None:
        """Send the page or, if the address ends in ``events``, the run's events until the server is closed."""
        if not self._is_admitted():
            return
        what = self.path.split("/", 2)[2] if self.path.count("/") > 1 else None
        if what == "":
            nonce = secrets.token_urlsafe(16)
            page = _PAGE.read_text(encoding="utf-8").replace("NONCE", nonce)
            self._send(HTTPStatus.OK, page, "text/html", nonce)
        elif what == "events":
            self._events()
        else:
            self._send(HTTPStatus.NOT_FOUND, "There is no such page.")

    def do_POST(self) -> None:
        """Stop the run if the address ends in ``stop``, unless a different page sent the request."""
        origin = self.headers.get("Origin")
        if not self._is_admitted() or (origin is not None and not self._is_from_here(origin)):
            return
        if self.path.split("/", 2)[2:] != ["stop"]:
            self._send(HTTPStatus.NOT_FOUND, "There is no such page.")
            return
        why = self.server.stop_run()
        self._send(HTTPStatus.CONFLICT if why else HTTPStatus.ACCEPTED, why)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, because the address is secret."""

    def _is_admitted(self) -> bool:
        admitted = self.server.admits(self.headers.get("Host"), self.path)
        if not admitted:
            self._send(HTTPStatus.FORBIDDEN, "Open the whole address that fmu watch --web has printed.")
        return admitted

    def _is_from_here(self, origin: str) -> bool:
        try:
            same = urlsplit(origin).netloc == self.headers.get("Host")
        except ValueError:  # the origin is not an address
            same = False
        if not same:
            self._send(HTTPStatus.FORBIDDEN, "Only the page itself may stop the run.")
        return same

    def _send(self, status: HTTPStatus, text: str, kind: str = "text/plain", nonce: str = "") -> None:
        body = text.encode()
        self.send_response(status)
        self._headers(f"{kind}; charset=utf-8", nonce)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _headers(self, kind: str, nonce: str = "") -> None:
        own = f"'nonce-{nonce}'"
        inline = f"script-src {own}; style-src {own}; connect-src 'self'; img-src data:; " if nonce else ""
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", f"default-src 'none'; {inline}frame-ancestors 'none'")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")

    def _events(self) -> None:
        """Send an event for every reading, or the error if a reading fails, until the server is closed."""
        self.send_response(HTTPStatus.OK)
        self._headers("text/event-stream")
        self.end_headers()
        while not self.server.closing.is_set():
            try:
                what = page_content(self.server.reading())
            except (ValueError, OSError) as error:
                what = {"gone": str(error)}
            self.wfile.write(f"data: {as_json(what)}\n\n".encode())
            self.wfile.flush()
            self.server.closing.wait(self.server.every)
