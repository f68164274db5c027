"""fmu watch --web: the page of a run, who may open it, and what its button does."""

import http.client
import json
import os
import re
import shutil
import signal
import socket
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import pytest
from click.testing import CliRunner

from fmu.cli import main
from fmu.runs import web
from fmu.runs.lock import announce
from fmu.runs.status import RunReader
from fmu.runs.web import WatchServer
from tests.cli.forked import begun, exit_code, is_running, line_of
from tests.cli.runs import problem_in
from tests.report.browser import needs_browser
from tests.report.conftest import browser, chromium  # noqa: F401
from tests.runs.keeping import at_keep

SAMPLERS = ("--sampler", "mh", "--sampler", "slice")
RUN = ("run", "two.toml", "--warmup", "10", "--draws", "20", "--chains", "8", "--groups", "8", "--starts", "2",
       "--keep-draws", "10", "--no-report", "--progress", "none", "--out", "out", *SAMPLERS)  # fmt: skip
HOSTILE = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of two samplers with eight groups each that stopped in the second."""
    folder = problem_in(tmp_path_factory.mktemp("stopped"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        at_keep(patch, 40, lambda: signal.raise_signal(signal.SIGTERM))
        assert CliRunner().invoke(main, RUN).exit_code == 130
    return folder / "out"


@pytest.fixture
def out(stopped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(stopped, "out"))


@contextmanager
def served(directory, every=0.02, **options):
    with WatchServer(directory, every, **options) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server, method="GET", path=None, **headers):
    """Return status, headers and text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    own = urlsplit(server.address).path
    connection.request(method, own if path is None else path.replace("OWN", own), headers=headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, answer.headers, text


@contextmanager
def events(address):
    """The events of a page that is open."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=30)
    connection.request("GET", parts.path + "events")
    answer = connection.getresponse()
    assert (answer.status, answer.headers.get_content_type()) == (200, "text/event-stream")
    yield (json.loads(line.removeprefix(b"data: ")) for line in answer if line.startswith(b"data: "))
    answer.close()
    connection.close()


def test_numbers_are_those_of_json_and_words_those_of_the_table(out, monkeypatch):
    announce(out / "checkpoints")
    now = time.time() + 3.0
    monkeypatch.setattr(time, "time", lambda: now)
    with served(out) as server, events(server.address) as told:
        seen = next(told)
    assert seen["reading"] == json.loads(CliRunner().invoke(main, ["watch", "out", "--json"]).stdout)
    samplers = {sampler["name"]: sampler for sampler in seen["reading"]["samplers"]}
    assert [samplers["mh"]["state"], samplers["slice"]["state"]] == ["finished", "running"]
    assert len(samplers["slice"]["groups"]) == 8
    assert [samplers[name]["together"]["chains"] for name in samplers] == [8, 8]
    assert samplers["mh"]["together"]["rhat"] > 0.9
    table = CliRunner().invoke(main, ["watch", "out"]).stdout.splitlines()
    assert f"out: {seen['state']}" == table[0]
    assert seen["runs"]
    drop = seen["header"].index("chains")
    lines = [row[:drop] + row[drop + 1 :] for row in seen["rows"]]
    shown = [line.split("  ") for line in table[3 : 3 + len(lines)]]
    assert [[cell for cell in line if cell] for line in lines] == [
        [cell.strip() for cell in line if cell.strip()] for line in shown
    ]


def test_only_who_has_the_address_is_answered(out):
    with served(out) as server:
        port = server.server_port
        assert re.fullmatch(rf"http://127\.0\.0\.1:{port}/[\w-]{{43}}/", server.address)
        status, headers, text = ask(server)
        assert (status, headers["Cache-Control"], headers["Referrer-Policy"]) == (200, "no-store", "no-referrer")
        nonce = re.search(r"script-src 'nonce-([\w-]+)'", headers["Content-Security-Policy"])[1]
        assert text.count(f'nonce="{nonce}"') == 2
        assert "NONCE" not in text
        wrong = "/" + "x" * 43 + "/"
        for path in ("/", "/events", "/stop", wrong, wrong + "events", "/%00/", "*"):
            for method in ("GET", "POST"):
                assert ask(server, method, path)[0] == 403, (method, path)
        assert ask(server, path="OWN", Host=f"evil.example:{port}")[0] == 403
        assert ask(server, path="OWN", Host="")[0] == 403
        assert ask(server, path="OWN", Host="[")[0] == 403
        for host in (f"localhost:{port}", "127.0.0.1:9000", "[::1]:9000"):  # through a tunnel, the port is another
            assert ask(server, path="OWN", Host=host)[0] == 200
        assert ask(server, "POST", "OWNstop", Origin="http://evil.example")[0] == 403
        assert ask(server, "POST", "OWNstop", Origin="http://[")[0] == 403
        assert ask(server, path="OWNstop")[0] == 404
        assert ask(server, "POST", "OWNother")[0] == 404
        assert ask(server, "DELETE", "OWN")[0] == 501


def test_too_many_connections_are_closed(out):
    with served(out, most_connections=2) as server:
        silent = [socket.create_connection(server.server_address[:2]) for _ in range(2)]
        time.sleep(0.2)  # until both are accepted
        with socket.create_connection(server.server_address[:2]) as third:
            third.settimeout(10.0)
            assert third.recv(1) == b""
        for one in silent:
            one.close()


def test_a_request_that_comes_in_byte_by_byte_is_closed(out):
    with served(out, request_s=0.3) as server, socket.create_connection(server.server_address[:2]) as slow:
        slow.settimeout(5.0)
        slow.sendall(b"GET / HT")
        time.sleep(0.15)
        slow.sendall(b"TP")
        assert slow.recv(1) == b""  # long before the server's patience with a silent connection ends


def test_it_listens_at_the_loopback_alone(out):
    with served(out) as server:
        assert server.server_address[0] == "127.0.0.1"
        with pytest.raises(
            ValueError, match=rf"--web: must be able to listen at 127\.0\.0\.1, port {server.server_port}"
        ):
            WatchServer(out, 1.0, port=server.server_port)


def test_a_run_that_is_not_running_is_not_stopped(out, monkeypatch):
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("nothing is to be killed"))
    with served(out) as server:
        assert ask(server, "POST", "OWNstop")[::2] == (409, "It is not running.")


def test_a_run_on_another_machine_is_stopped_there(out, monkeypatch):
    announce(out / "checkpoints")
    monkeypatch.setattr(socket, "gethostname", lambda: "another")
    here = json.loads((out / "checkpoints" / "at-work.json").read_text())["host"]
    assert web.why_not_to_stop(RunReader(out).read()) == f"It runs on {here} and can only be stopped there."


def test_a_directory_that_goes_is_said(out):
    with served(out) as server, events(server.address) as told:
        assert "reading" in next(told)
        shutil.rmtree(out)
        gone = next(one for one in told if "gone" in one)
    assert "must be the directory of a run" in gone["gone"]


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_live_run_goes_on_when_the_page_is_closed_and_stops_when_it_is_told(forked_runs, tmp_path):
    """Two processes: a run, and the command that watches it."""
    at_work = problem_in(tmp_path) / "out" / "checkpoints" / "at-work.json"
    pids = [begun(forked_runs, tmp_path, "", *(word if word != "20" else "10000000" for word in RUN))]
    try:
        while not at_work.is_file():
            assert is_running(pids[0]), (tmp_path / "said").read_text()
            time.sleep(0.02)
        pids.append(begun(forked_runs, tmp_path, "", "watch", "out", "--web", "--every", "0.1"))
        run, page = pids
        (address,) = line_of(forked_runs, "http://")
        with events(address) as told:
            first = next(one for one in told if one["rows"] and one["rows"][0][3])
            assert (first["runs"], first["why_not_to_stop"]) == (True, "")
            assert first["reading"]["at_work"]["pid"] == run
        time.sleep(0.3)
        assert is_running(run)  # closing the page stops nothing
        with events(address) as told:
            assert next(told)["runs"]
            parts = urlsplit(address)
            connection = http.client.HTTPConnection(parts.hostname, parts.port)
            connection.request("POST", parts.path + "stop")
            assert connection.getresponse().status == 202
            connection.close()
            assert exit_code(forked_runs, run) == 130
            ended = next(one for one in told if not one["runs"])
        assert (ended["state"], ended["ended"], ended["to_resume"]) == ("stopped", True, "fmu run --resume out")
        assert is_running(page)  # a page that is left open can say so, and follows a run that is resumed
        os.kill(page, signal.SIGINT)
        assert exit_code(forked_runs, page) == 0
    finally:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("more", ["--json", "--follow"])
def test_it_follows_by_itself(out, more):
    told = CliRunner().invoke(main, ["watch", "out", "--web", more], prog_name="fmu")
    assert told.exit_code == 2
    assert told.stderr == "Error: --web follows the run by itself: leave out --json and --follow.\n"


@needs_browser
def test_in_a_browser(browser, stopped, tmp_path):  # noqa: F811
    from selenium.webdriver.support.wait import WebDriverWait

    directory = Path(shutil.copytree(stopped, tmp_path / HOSTILE))
    announce(directory / "checkpoints")
    wait, text = WebDriverWait(browser, 10), "return document.body.innerText"
    with served(directory, 0.1) as server:
        for width in (390, 768, 1280):
            size = {"width": width, "height": 740, "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            for log in ("browser", "performance"):
                browser.get_log(log)
            browser.get(server.address)
            wait.until(lambda b: "running for" in b.execute_script(text))
            assert HOSTILE in browser.execute_script(text)
            assert browser.execute_script("return document.querySelectorAll('#rows tr').length") == 10
            assert browser.execute_script("return document.documentElement.scrollWidth") <= width
            assert browser.execute_script("return document.querySelector('#stop').disabled") is False
            assert browser.get_log("browser") == []
            messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
            asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
            assert all(url.startswith((server.address, "data:")) for url in asked)
        (directory / "checkpoints" / "at-work.json").unlink()
        wait.until(lambda b: "stopped. The run has ended." in b.execute_script(text))
        assert "To resume: fmu run --resume" in browser.execute_script(text)
        assert browser.execute_script("return document.querySelector('#stop').disabled") is True
    wait.until(lambda b: "fmu watch cannot be reached" in b.execute_script(text))


def test_neither_a_stop_nor_the_end_waits_for_a_reading(out, monkeypatch):
    killed = []
    monkeypatch.setattr(web.os, "kill", lambda pid, number: killed.append((pid, number)))
    monkeypatch.setattr(web, "why_not_to_stop", lambda reading: "")
    server = WatchServer(out, 0.02)
    ends = threading.Event()
    monkeypatch.setattr(server, "_reading", SimpleNamespace(at_work=SimpleNamespace(pid=4242)))
    monkeypatch.setattr(server._reader, "read", lambda: ends.wait(60))
    reading = threading.Thread(target=server.reading, daemon=True)
    reading.start()
    while not server._lock.locked():
        time.sleep(0.001)
    assert server.stop_run() == ""
    assert killed == [(4242, signal.SIGTERM)]
    server.server_close()
    assert reading.is_alive()
    ends.set()
    reading.join()
