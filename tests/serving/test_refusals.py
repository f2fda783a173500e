"""What the page refuses changes nothing, and what it reads keeps nobody waiting."""

import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from urllib.parse import quote

import pytest
from served import PATIENCE, Served, serving

from minimax_cal.measuring.importers import read_in_first_fitting_format
from minimax_cal.measuring.importers.column_tables import ImportOptions

pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")

from minimax_cal.webapp import bounded_connection
from minimax_cal.webapp.routes import PAGE_ROUTES

JOINTS = "Pose,q1_deg,q2_deg\nP1,1,2\nP2,3,4\n"
POINTS = "Pose,x_mm,y_mm,z_mm\nP1,1,2,3\nP2,3,4,5\n"
TARGETS = "q1_deg,q2_deg\n1,2\n"
LARGE = 25_000_000  # bytes
SOON = 1.0  # seconds in which a second tab has its answer


def digest(folder: Path) -> dict[str, str]:
    """Every file and folder, and what it holds."""
    return {
        str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest()
        if path.is_file()
        else ""
        for path in folder.rglob("*")
    }


def take(server: Served, home: str, kind: object, names: object) -> int:
    return server.ask("POST", f"{home}/given", json.dumps({"kind": kind, "names": names})).status


@pytest.fixture(scope="module")
def home(server: Served) -> str:
    """A session with files of each kind, chosen."""
    made = server.begin("refusals", robot="irb120")
    for kind, name, text in (
        ("measured", "joints.csv", JOINTS), ("measured", "points.csv", POINTS),
        ("targets", "targets.csv", TARGETS),
    ):  # fmt: skip
        assert server.put(made, name, text.encode()).status == 200
        assert take(server, made, kind, [name]) == 200
    assert server.put(made, "spare.csv", b"not,a,file\nof,joint,targets\n").status == 200
    return made


def many(entry: str) -> list[str]:
    return [entry.format(number) for number in range(100_000)]


BODIES = ["", "[]", "{", "1" * (2 << 20), "[" * 100_000, "\x00", '{"a": NaN}']
REFUSED: list[tuple[str, str, str]] = [  # method, path after the session's, body
    *(("PATCH", "/choices", body) for body in BODIES),
    *(
        ("PATCH", "/choices", json.dumps(body))
        for body in (
            {"robot": "nobody"}, {"measured": ["none.csv"]}, {"rms": -1}, {"own": 1}, {"poses": 0},
            {"left_out": many("{}:smr1")}, {"reasons": dict.fromkeys(many("{}"), "knocked")},
            {"measured": many("{}.csv")}, {"rms": 0.1, "targets": "none.csv"},
        )
    ),
    *(("POST", "/given", body) for body in BODIES),
    *(
        ("POST", "/given", json.dumps({"kind": kind, "names": names}))
        for kind, names in (
            ("targets", ["none.csv"]), ("targets", ["spare.csv"]), ("targets", ["points.csv"]),
            ("targets", []), ("targets", "spare.csv"), ("targets", [1]), ("targets", ["../x"]),
            ("measured", ["none.csv"]), ("measured", ["points.csv", "none.csv"]),
            ("measured", ["../x"]), ("measured", many("{}.csv")), ("measured", [None]),
            ("robot", ["none.csv"]), ("robot", ["\ud800"]), ("report", ["spare.csv"]), (7, ["a"]),
        )
    ),
    *(("PUT", f"/given?name={name}", "x") for name in ("", "..", "a%2Fb", "con.csv", "NUL", ".x")),
    ("PUT", f"/given?name={quote('測' * 100)}", "x"),
    *(("DELETE", f"/given?name={name}", "") for name in ("", "..", "%2Fetc%2Fpasswd", "con")),
    *(("POST", f"/run/{step}", "") for step in ("rm", "fit", "judge", "plan", "urdf", "..%2Ffit")),
    *(("GET", f"/file/{name}", "") for name in ("none", "..%2Fx", "given%2Fspare.csv", "%00",
                                               quote("測" * 100))),
    *(("GET", f"/view/{name}", "") for name in ("none", "workspace", "ladder")),
    *(("PUT", path, "x") for path in ("", "/state", "/cancel", "/file/fit.json")),
]  # fmt: skip


def test_a_refused_request_changes_nothing(server, home):
    """Of every route, with everything that it refuses."""
    before = digest(server.folder)
    for method, path, body in REFUSED:
        answer = server.ask(method, home + path, body or None)
        said = (method, path, body[:60], answer.text)
        assert 400 <= answer.status < 500, said
        assert digest(server.folder) == before, said
    elsewhere = ("/s/none", "/s/con", "/s/..%2f..", "/s/%00")
    for method, path in (
        *(("POST", "/sessions"), ("GET", "/static/none")),
        *((method, f"{place}{path}") for place in elsewhere for method, path in (
            ("GET", "/state"), ("GET", ""), ("PATCH", "/choices"), ("PUT", "/given?name=x.csv"),
            ("POST", "/given"), ("DELETE", "/given?name=x.csv"), ("POST", "/run/read"),
            ("POST", "/cancel"), ("GET", "/file/x"), ("GET", "/view/ladder"))),
    ):  # fmt: skip
        answer = server.ask(method, path, "{" if path == "/sessions" else None)
        assert 400 <= answer.status < 500, (method, path, answer.text)
        assert digest(server.folder) == before, (method, path)


def test_every_route_that_changes_is_asked_for_what_it_refuses():
    asked = {(method, path.partition("?")[0].split("/")[1:2][0]) for method, path, _ in REFUSED
             if path}  # fmt: skip
    for route in PAGE_ROUTES:
        name = route.path.removeprefix("/s/{session}").split("/")[1:2]
        for method in (route.methods or set()) - {"GET", "HEAD"}:
            if route.path not in ("/sessions", "/s/{session}/cancel"):
                assert (method, *name) in asked, (method, route.path)


def test_a_file_that_is_no_better_leaves_the_one_before(server, home):
    """Looked at before anything goes: of targets, and of points that cannot be read."""
    folder = server.folder / home.rpartition("/")[2]
    assert server.put(home, "broken.csv", (POINTS + "P3,4\n").encode()).status == 200
    assert take(server, home, "targets", ["spare.csv"]) == 400
    assert take(server, home, "measured", ["broken.csv"]) == 200
    chosen = json.loads((folder / "session.json").read_text())
    assert chosen["targets"] == "targets.csv"
    assert chosen["measured"] == ["joints.csv", "points.csv", "broken.csv"]
    assert (folder / "given" / "points.csv").read_text() == POINTS
    assert server.ask("DELETE", f"{home}/given?name=broken.csv").status == 200
    server.done(home)


def test_a_wrong_file_that_is_removed_frees_what_comes_after(server):
    """Also where it was dropped with the right one, so that nothing had been read."""
    made = server.begin("wrong", robot="irb120")
    q = ",".join(f"q{j}_deg" for j in range(1, 7))
    rows = "\n".join(f"{i},{2 * i},{3 * i},4,5,6,{i},2,3" for i in range(30))
    server.put(made, "right.csv", f"{q},smr1_x_mm,smr1_y_mm,smr1_z_mm\n{rows}\n".encode())
    server.put(made, "wrong.csv", b"a,b\n1,2\n")
    assert take(server, made, "measured", ["right.csv", "wrong.csv"]) == 200
    state = server.run(made, "read")
    assert state["steps"]["read"]["state"] == "failed"
    assert state["steps"]["fit"]["waits"]
    assert server.ask("DELETE", f"{made}/given?name=wrong.csv").status == 200
    state = server.done(made)
    assert state["steps"]["read"]["state"] == "done"
    assert state["steps"]["fit"]["waits"] == ""


# ---- nobody waits --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A file of measurements of 25 MB that takes seconds to read."""
    header = ",".join([*(f"q{j}_deg" for j in range(1, 7)), "smr1_x_mm,smr1_y_mm,smr1_z_mm"])
    row = ",".join(f"{j}.123456789" for j in range(9)) + "\n"
    content = f"{header}\n{row * (LARGE // len(row))}".encode()
    assert len(content) > 0.99 * LARGE
    return content


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server of its own, which may be left at work."""
    with serving(tmp_path_factory.mktemp("busy")) as found:
        yield found


@pytest.mark.parametrize("kind", ["measured", "targets", "robot"])
def test_a_second_tab_is_answered_while_a_large_file_is_read(busy, large, kind):
    """Of the same session and of another, from the first byte to the end of the reading."""
    made, other = busy.begin(f"large {kind}"), busy.begin("other", robot="irb120")
    busy.state(other)
    sent = time.monotonic()
    reading = threading.Thread(target=read_large, args=(busy, made, kind, large))
    reading.start()
    waits = []
    while reading.is_alive():
        for path in (f"{other}/state", f"{other}/state?seen=none", "/", other):
            began = time.monotonic()
            assert busy.ask("GET", path).status == 200
            waits.append((time.monotonic() - began, path, began - sent))
            time.sleep(0.02)
    assert len(waits) > 4, "the file is read too fast to say anything"
    # On a machine that does much else a second may be short: then half of the reading is the limit.
    assert max(waits)[0] < max(SOON, 0.5 * (time.monotonic() - sent)), max(waits)


def read_large(server: Served, home: str, kind: str, content: bytes) -> None:
    assert server.put(home, "large.csv", content).status == 200
    assert take(server, home, kind, ["large.csv"]) == 200
    server.ask("GET", f"{home}/state")


# ---- half-open connections -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def impatient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server whose patience is a tenth."""
    code = (
        "import minimax_cal.webapp.bounded_connection as c, minimax_cal.cli as m; "
        "c.MAX_HEAD_SECONDS /= 10; c.MAX_SILENT_BODY_SECONDS /= 30; "
        "c.MAX_BLOCKED_WRITE_SECONDS /= 60; m.main()"
    )
    with serving(tmp_path_factory.mktemp("impatient"), "-c", code) as found:
        yield found


def ended(line: socket.socket) -> float:
    """Seconds until the other end closes a connection."""
    began = time.monotonic()
    line.settimeout(PATIENCE)
    try:
        while line.recv(1 << 16):
            pass
    except ConnectionError:
        pass
    return time.monotonic() - began


@pytest.mark.parametrize(
    "sent",
    ["", "GET / HT", "GET / HTTP/1.1\r\nhost: x\r\n",
     "PUT HOME/given?name=half.csv HTTP/1.1\r\nhost: 127.0.0.1:PORT\r\ncookie: COOKIE\r\n"
     "content-length: 1000\r\n\r\nq1_deg",
     "PATCH HOME/choices HTTP/1.1\r\nhost: 127.0.0.1:PORT\r\ncookie: COOKIE\r\n"
     "content-length: 1000\r\n\r\n{"],
    ids=["nothing", "half a line", "half a head", "half a file", "half a choice"],
)  # fmt: skip
def test_a_half_open_connection_ends(impatient, sent):
    made = impatient.begin("half")
    before = digest(impatient.folder)
    for word, value in (("HOME", made), ("PORT", str(impatient.port)),
                        ("COOKIE", f"minimax-cal-{impatient.port}={impatient.token}")):  # fmt: skip
        sent = sent.replace(word, value)
    with socket.create_connection(("127.0.0.1", impatient.port)) as line:
        line.sendall(sent.encode())
        assert ended(line) < 30.0
    end = time.monotonic() + PATIENCE
    while digest(impatient.folder) != before:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_head_that_comes_in_drops_ends(impatient):
    """A byte now and then wins no time."""
    began = time.monotonic()
    with socket.create_connection(("127.0.0.1", impatient.port)) as line:
        try:
            while time.monotonic() < began + PATIENCE:
                line.sendall(b"G")
                time.sleep(0.1)
        except ConnectionError:
            pass
    assert time.monotonic() - began < 30.0


def test_an_answer_that_nobody_reads_ends(impatient):
    made = impatient.begin("unread")
    folder = impatient.folder / made.rpartition("/")[2]
    (folder / "fit.json").write_bytes(bytes(50_000_000))
    request = (
        f"GET {made}/file/fit.json HTTP/1.1\r\nhost: 127.0.0.1:{impatient.port}\r\n"
        f"cookie: minimax-cal-{impatient.port}={impatient.token}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", impatient.port)) as line:
        line.sendall(request.encode())
        time.sleep(bounded_connection.MAX_BLOCKED_WRITE_SECONDS / 60 + 2.0)
        taken = 0
        try:
            while part := line.recv(1 << 20):
                taken += len(part)
        except ConnectionError:
            pass
    assert taken < 50_000_000
    (folder / "fit.json").unlink()


def test_a_connection_that_asks_stays(impatient):
    """Whoever sends a file slowly, but sends it, is heard to the end."""
    made, content = impatient.begin("slow"), b"x" * 40
    head = (
        f"PUT {made}/given?name=slow.csv HTTP/1.1\r\nhost: 127.0.0.1:{impatient.port}\r\n"
        f"cookie: minimax-cal-{impatient.port}={impatient.token}\r\ncontent-length: 40\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", impatient.port)) as line:
        line.sendall(head.encode())
        for byte in content:
            line.sendall(bytes([byte]))
            time.sleep(0.05)  # in sum twice the patience with silence
        assert line.recv(1 << 16).startswith(b"HTTP/1.1 200")


def test_the_large_file_is_one_that_is_read(large, tmp_path):
    (tmp_path / "large.csv").write_bytes(large[: 1 << 20].rpartition(b"\n")[0])
    assert read_in_first_fitting_format(tmp_path / "large.csv", ImportOptions()).joint_columns


# ---- processes that die --------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells who is whose child")
def test_readers_that_were_killed_are_replaced(busy):
    """As by a system that runs out of memory."""
    made = busy.begin("killed", robot="irb120")
    before = busy.state(made)
    number = busy.process.pid
    children = Path(f"/proc/{number}/task/{number}/children").read_text().split()
    readers = [pid for pid in children if b"webapp.session_reader" in
               Path(f"/proc/{pid}/cmdline").read_bytes()]  # fmt: skip
    assert readers
    for pid in readers:
        os.kill(int(pid), signal.SIGKILL)
    assert busy.state(made) == before
