"""The page's work is the command line's: same numbers, whole files, ended when it is to end."""

import html
import http.client
import json
import os
import re
import socket
import stat
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from conftest import run
from served import PATIENCE, Served, serving

import minimax_cal as mc

pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
POSES, TARGETS = 30, 2
TOO_LARGE = str(2 << 30)
STARTING = ("waiting for a free core", "diagnose")  # what a job says before its process does


def measured(folder: Path, poses: int) -> bytes:
    """A file of a synthetic cell."""
    path = folder / "poses.csv"
    data = mc.simulate("irb120", poses, TARGETS, seed=4).data
    mc.write_measurements(path, replace(data, simulated=False))
    return path.read_bytes()


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return measured(tmp_path_factory.mktemp("cell"), POSES)


def begun(server: Served, name: str, content: bytes, *named: str, **choices: Any) -> str:
    """A session about an IRB 120 and one file of measurements; its address."""
    home = server.begin(*named, robot="irb120", **choices)
    server.put(home, name, content)
    server.choose(home, measured=[name])
    return home


@pytest.fixture(scope="module")
def fitted(server: Served, poses: bytes) -> str:
    """A session that is read and calibrated; its address."""
    home = begun(server, "tracker.csv", poses, objective="sum")
    for step in ("read", "fit"):
        found = server.run(home, step)["steps"][step]
        assert found["state"] == "done", found
    return home


def folder_of(server: Served, home: str) -> Path:
    return server.folder / home.rpartition("/")[2]


def result(path: Path) -> dict[str, Any]:
    """A result without what tells only how long it took."""
    content: dict[str, Any] = json.loads(path.read_text())
    content.pop("seconds")
    return content


def at_work(folder: Path) -> list[int]:
    """Processes whose folder this is."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if (path / "cwd").resolve() == folder.resolve():
                found.append(int(path.name))
        except OSError:
            continue
    return found


# ---- the same as the command line ----------------------------------------------------------------


def test_the_numbers_are_those_of_the_command_line(server, fitted, tmp_path, monkeypatch):
    monkeypatch.chdir(folder_of(server, fitted))
    (line,) = server.state(fitted)["steps"]["fit"]["lines"]
    words = line.removeprefix("minimax-cal ").removesuffix("fit.json").split()
    assert run(*words, tmp_path / "fit.json") == 0
    assert result(tmp_path / "fit.json") == result(Path("fit.json"))


def test_the_script_of_the_session_does_it_all_again(server, fitted):
    state = server.state(fitted)
    script = (folder_of(server, fitted) / "commands.sh").read_text()
    for step in ("read", "fit"):
        for line in state["steps"][step]["lines"]:
            assert f"\n{line}\n" in script


@pytest.mark.slow
def test_a_point_that_is_unticked_is_out_of_the_next_fit(server, fitted):
    worst = folder_of(server, fitted) / "fit.json"
    before = result(worst)
    server.choose(fitted, left_out=["2:smr1", "5:smr2"], reasons={"5:smr2": "knocked"})
    assert server.state(fitted)["steps"]["fit"]["state"] == "old"
    state = server.run(fitted, "fit")
    assert state["steps"]["fit"]["state"] == "done"
    now = result(worst)
    assert now["poses"]["errors_mm"] != before["poses"]["errors_mm"]
    rows = {line: row for row, line in enumerate(now["poses"]["line"])}
    assert now["poses"]["measured_mm"][rows[2]][0] == [None, None, None]
    assert now["poses"]["measured_mm"][rows[5]][1] == [None, None, None]
    assert {(p["row"], p["target"], p["by"]) for p in now["set_aside"]} == {
        (2, "smr1", "user"), (5, "smr2", "user")}  # fmt: skip
    assert now["set_aside"][-1]["why"] == "knocked" or now["set_aside"][0]["why"] == "knocked"
    assert 'data-point="2:smr1"' in state["panels"]["points"]  # listed all the same
    assert 'data-why="5:smr2"' in state["panels"]["points"]
    server.choose(fitted, left_out=[])
    assert server.state(fitted)["steps"]["fit"]["state"] == "old"


def test_an_error_is_the_line_of_the_command(server):
    home = begun(server, "points.csv", b"a,b\n1,2\n")
    found = server.run(home, "read")["steps"]["read"]
    assert found["state"] == "failed"
    assert found["error"].startswith("given/points.csv:1: columns a, b are not known; say what")
    assert not (folder_of(server, home) / "poses.csv").exists()
    assert not (folder_of(server, home) / "understood.json").exists()


def test_files_of_tracker_and_controller_are_one(server, poses):
    """Without headers: what they do not tell is chosen, and goes to the command as it is."""
    home = server.begin(robot="irb120")
    rows = [line.split(",") for line in poses.decode().splitlines()[1:]]
    for name, part in (("joints.txt", slice(0, 6)), ("smr_1.txt", slice(6, 9))):
        server.put(home, name, "\n".join(" ".join(row[part]) for row in rows).encode())
    files = ["smr_1.txt", "joints.txt"]
    server.choose(home, measured=files, joints="joints.txt", units="q=rad,smr=mm")
    state = server.run(home, "read")
    assert state["steps"]["read"]["state"] == "done", state["steps"]["read"]["error"]
    assert f"{POSES} poses, 6 joints, targets smr1" in state["panels"]["understood"]
    found = mc.read_measurements(folder_of(server, home) / "poses.csv")
    assert found.q.shape == (POSES, 6)


def test_names_are_those_of_the_files(server, poses):
    """Of poses, and of the tracker's targets, in the table of points and in the view."""
    home = server.begin(robot="irb120", objective="sum")
    rows = [line.split(",") for line in poses.decode().splitlines()[1:]]
    points = [["Pose;Nest;x_mm;y_mm;z_mm"]]
    points += [[f"P{i:03d}", nest, *row[k : k + 3]] for i, row in enumerate(rows, 1)
               for nest, k in (("left", 6), ("right", 9))]  # fmt: skip
    joints = [["Pose", *(f"q{j}_rad" for j in range(1, 7))]]
    joints += [[f"P{i:03d}", *row[:6]] for i, row in enumerate(rows, 1)]
    for name, lines in (("points.csv", points), ("joints.csv", joints)):
        server.put(home, name, "\n".join(map(";".join, lines)).encode())
        told = json.dumps({"kind": "measured", "names": [name]})
        assert server.ask("POST", f"{home}/given", told).status == 200
    for step in ("read", "fit"):
        state = server.run(home, step)
        assert state["steps"][step]["state"] == "done", state["steps"][step]
    assert state["panels"]["understood"].count("<details open>") == 2
    shown = state["panels"]["points"]
    assert ">pose P007<" in shown
    assert "smr1 (left)" in shown
    called = server.ask("GET", f"{home}/view/workspace").json["arms"]["called"]
    assert called["8"] == "pose P007"
    assert "ABB IRB 120: links and limits" in state["panels"]["robot"]


def test_accuracy_stands_beside_each_download(server, fitted):
    """That of the file itself, as the command says it."""
    server.put(fitted, "targets.csv", b"q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n1,2,3,4,5,6\n")
    server.choose(fitted, targets="targets.csv")
    for step in ("urdf", "mjcf", "correct"):
        panels = server.run(fitted, step)["panels"]
    for name, words in (
        ("fit.json", r"RMS error [\d.]+ mm -&gt; [\d.]+ mm"),
        ("robot.urdf", r"urdf holds geometry alone: held-out RMS [\d.]+ mm"),
        ("robot.xml", r"mjcf holds .*: held-out RMS [\d.]+ mm"),
        ("corrected.csv", r"Expect on the arm: held-out RMS [\d.]+ mm"),
    ):
        row = panels["downloads"].partition(f"download>{name}<")[2].partition("</li>")[0]
        assert re.search(words, row), row
    assert "─" not in panels["told"]  # tables are not prose
    assert "Expect on the arm" in panels["told"]
    assert server.ask("DELETE", f"{fitted}/given?name=targets.csv").status == 200


def test_a_diagnosis_is_said_in_paragraphs(server, results):
    """A paragraph for each sentence of the terminal's first screen."""
    home = server.begin(robot="ur10")
    text = (results / "gap.json").read_text()
    (folder_of(server, home) / "diagnosis.json").write_text(text)
    shown = server.state(home)["panels"]["ladder"]
    said = mc.Diagnosis.load(results / "gap.json").said
    assert len(said) > 1
    assert [html.unescape(one) for one in re.findall(r'<p class="headline">(.*)</p>', shown)] == [
        *said
    ]


def test_names_from_files_are_only_text(server, poses):
    """Of a file and of its columns, wherever they are shown."""
    header, _, rows = poses.partition(b"\n")
    lines = [line + b",1" for line in rows.splitlines()]
    text = b"\n".join([header + b",<img src=x onerror=alert(1)>", *lines])
    home = begun(server, "a(b).csv", text)
    state = server.run(home, "read")
    assert state["steps"]["read"]["state"] == "done"
    shown = "".join(state["panels"].values())
    assert "&lt;img src=x" in shown
    assert "<img" not in shown


@pytest.mark.slow
def test_a_requirement_is_judged_by_the_report(server, fitted):
    server.choose(fitted, rms=50.0)
    state = server.run(fitted, "judge")
    told = state["panels"]["verdict"]
    assert 'banner passed">Passed inside the measured region</p>' in told
    server.choose(fitted, rms=1e-6)
    assert server.state(fitted)["steps"]["judge"]["state"] == "old"
    state = server.run(fitted, "judge")
    assert 'banner failed">Not passed</p>' in state["panels"]["verdict"]
    assert state["steps"]["judge"] | {"state": "done", "error": ""} == state["steps"]["judge"]
    look = server.ask("GET", f"{fitted}/file/report.html?look")
    assert look.headers["content-type"].startswith("text/html")
    assert "sandbox" in look.headers["content-security-policy"]
    assert "allow-same-origin" not in look.headers["content-security-policy"]


def test_files_are_given_to_keep_and_never_shown(server, fitted):
    answer = server.ask("GET", f"{fitted}/file/fit.json")
    assert answer.body == (folder_of(server, fitted) / "fit.json").read_bytes()
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"].startswith("attachment")


# ---- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["../fit.json", "..%2Ffit.json", "%2Fetc%2Fpasswd", "a%5Cb.csv", "..", "", ".x", "%00"]
)
def test_a_path_in_a_file_name_is_refused(server, fitted, name):
    before = sorted(server.folder.rglob("*"))
    answer = server.put(fitted, name, b"x")
    assert answer.status == 400
    assert answer.json["error"].startswith("file name ")
    assert sorted(server.folder.rglob("*")) == before
    assert server.ask("DELETE", f"{fitted}/given?name={name}").status == 400
    assert server.ask("GET", f"{fitted}/file/{name}").status in (400, 404)


def test_a_path_to_a_session_is_refused(server):
    for name in ("..", "%2e%2e", "none", "..%2f.."):
        assert server.ask("GET", f"/s/{name}/state").status in (400, 404)
        assert server.ask("POST", f"/s/{name}/run/read").status in (400, 404, 405)


def test_two_gigabytes_are_refused_before_they_come(server, fitted):
    headers = {"content-length": TOO_LARGE}
    answer = server.ask("PUT", f"{fitted}/given?name=huge.csv", None, headers)
    assert answer.status == 413
    assert answer.json["error"] == (
        "huge.csv: is larger than 256 MiB; that is no file of measurements"
    )


def test_what_does_not_tell_its_length_is_counted(server, fitted):
    """Sent in chunks, as much as it likes: an end is put to it, and nothing is kept."""
    request = (
        f"PUT {fitted}/given?name=huge.csv HTTP/1.1\r\nhost: 127.0.0.1:{server.port}\r\n"
        f"cookie: minimax-cal-{server.port}={server.token}\r\ntransfer-encoding: chunked\r\n\r\n"
    )
    part = b"%x\r\n" % (1 << 22) + bytes(1 << 22) + b"\r\n"
    sent = 0
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as line:
        line.sendall(request.encode())
        try:
            while sent < int(TOO_LARGE):
                line.sendall(part)
                sent += 1 << 22
        except OSError:
            pass
    assert sent < 1 << 29
    names = {path.name for path in (folder_of(server, fitted) / "given").iterdir()}
    end = time.monotonic() + PATIENCE
    while any("huge" in name for name in names) and time.monotonic() < end:
        names = {path.name for path in (folder_of(server, fitted) / "given").iterdir()}
    assert names == {"tracker.csv"}


def test_a_file_without_its_length_is_refused(server, fitted):
    line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    line.putrequest("PUT", f"{fitted}/given?name=x.csv")
    line.putheader("cookie", f"minimax-cal-{server.port}={server.token}")
    line.putheader("transfer-encoding", "chunked")
    line.endheaders()
    assert line.getresponse().status == 411
    line.close()


DEEP = "[" * 100_000


def test_json_nested_too_deep_is_refused(server):
    home = server.begin()
    for method, path in (("PATCH", f"{home}/choices"), ("POST", "/sessions")):
        answer = server.ask(method, path, DEEP)
        assert (answer.status, answer.json["error"]) == (400, "expected a JSON object")


@pytest.mark.parametrize(
    "name", ["fit.json", "diagnosis.json", "understood.json", "log/fit.json", "given/robot.json"]
)
def test_deep_json_in_a_session_leaves_its_page(server, name):
    home = server.begin()
    (folder_of(server, home) / name).write_text('{"a":' * 100_000)
    if name.startswith("given"):
        server.choose(home, robot="robot.json")
    answer = server.ask("GET", f"{home}/state")
    assert answer.status == 200
    assert set(answer.json["steps"]) >= {"read", "fit"}
    assert server.ask("GET", f"{home}/view/workspace").status in (400, 404)


@pytest.mark.skipif(os.name == "nt", reason="permissions are those of POSIX")
def test_what_a_session_holds_is_private(server, fitted):
    folder = folder_of(server, fitted)
    found = {path: stat.S_IMODE(path.stat().st_mode) for path in [folder, *folder.rglob("*")]}
    assert len(found) > 6
    for path, mode in found.items():
        assert mode == (0o700 if path.is_dir() else 0o600), path


@pytest.mark.parametrize("body", ["", "[]", "{", '{"robot": 1}', '{"x": 1}', "x" * (2 << 20)])
def test_choices_that_are_none(server, fitted, body):
    answer = server.ask("PATCH", f"{fitted}/choices", body)
    assert answer.status == 400
    assert "\n" not in answer.json["error"]


def test_steps_that_are_none_or_cannot_be_done(server):
    home = server.begin()
    assert server.ask("POST", f"{home}/run/rm").json["error"] == "there is no such step"
    assert server.ask("POST", f"{home}/run/fit").json["error"].endswith("have not been read yet")


# ---- two at once, cancel, killed -----------------------------------------------------------------


@pytest.mark.slow
def test_two_sessions_work_at_once_and_one_waits_for_itself(server, fitted, poses):
    other = begun(server, "t.csv", poses, "other", objective="sum")
    server.run(other, "read")
    for home in (fitted, other):
        assert server.ask("POST", f"{home}/run/fit").status == 200
    again = server.ask("POST", f"{fitted}/run/judge")
    assert "work is going on in this session" in again.json["error"]
    states = [server.done(home) for home in (fitted, other)]
    assert [state["steps"]["fit"]["state"] for state in states] == ["done", "done"]
    one, two = (result(folder_of(server, home) / "fit.json") for home in (fitted, other))
    assert one["parameters"] == two["parameters"]


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A cell whose diagnosis takes far longer than to cancel it."""
    return measured(tmp_path_factory.mktemp("cell"), 300)


def waited_for(server: Served, home: str) -> Any:
    """A diagnosis that has told its first stage."""
    assert server.ask("POST", f"{home}/run/diagnose").status == 200
    end = time.monotonic() + PATIENCE
    while (job := server.state(home)["job"])["stage"] in STARTING:
        assert time.monotonic() < end
        time.sleep(0.05)
    return job


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells whose folder is where")
def test_work_that_is_cancelled_leaves_nothing(server, many):
    home = begun(server, "t.csv", many, objective="sum")
    server.run(home, "read")
    folder = folder_of(server, home)
    before = sorted(folder.rglob("*"))
    waited_for(server, home)
    assert at_work(folder)
    assert server.ask("POST", f"{home}/cancel").status == 200
    assert server.state(home)["job"] is None
    assert at_work(folder) == []
    assert sorted(folder.rglob("*")) == before


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells whose folder is where")
def test_a_killed_server_loses_no_finished_result(tmp_path, many):
    with serving(tmp_path) as first:
        home = begun(first, "t.csv", many, objective="sum")
        before = first.run(home, "read")
        waited_for(first, home)
        first.process.kill()
        first.process.wait()
    folder = folder_of(first, home)
    end = time.monotonic() + PATIENCE
    while at_work(folder):  # its work ends with it
        assert time.monotonic() < end
        time.sleep(0.05)
    parts = [path.name for path in folder.rglob(".*")]  # of what it was writing when it was killed
    assert all(name.startswith(".session.json.") for name in parts)
    with serving(tmp_path) as second:
        assert second.token != first.token
        after = second.state(home)
    same = ("choices", "panels", "views", "steps", "robots")
    assert {key: after[key] for key in same} == {key: before[key] for key in same}
    assert os.fspath(folder) in (folder / "commands.sh").read_text()
