"""Who may ask: the right host, the page itself, the token; and what every answer carries."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from served import PATIENCE

pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")


def test_the_token_opens_and_leaves_the_address(server):
    answer = server.ask("GET", f"/?token={server.token}", cookie="")
    assert answer.status == 303
    assert answer.headers["location"] == "/"  # the token is in no history and no referrer
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=lax" in cookie
    assert server.ask("GET", "/", cookie=cookie.partition(";")[0]).status == 403  # lower case
    assert server.ask("GET", "/").status == 200


@pytest.mark.parametrize("query", ["", "?token=", "?token=the-right-toke", "?token=%00"])
def test_without_the_token_nothing_is_told(server, query):
    for path in ("/", "/s/cell/state", "/static/serve.js", "/s/cell/file/fit.json"):
        answer = server.ask("GET", path + query, cookie="")
        assert answer.status == 403
        assert "open the address that minimax-cal serve printed" in answer.text
    assert server.ask("POST", f"/sessions{query}", "{}", cookie="").status == 403


def test_an_old_cookie_is_a_wrong_token(server):
    cookie = f"minimax-cal-{server.port}=of-the-last-server"
    assert server.ask("GET", "/", cookie=cookie).text.startswith("wrong token")


def test_the_token_leads_to_no_other_place(server):
    answer = server.ask("GET", f"//elsewhere.example/?token={server.token}", cookie="")
    assert not answer.headers.get("location", "/").startswith("//")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:PORT", "127.0.0.1:1", "127.0.0.1.evil.example:PORT", ""]
)
def test_a_name_that_leads_here_is_refused(server, host):
    """DNS rebinding: the browser tells the name in Host."""
    answer = server.ask("GET", "/", headers={"host": host.replace("PORT", str(server.port))})
    assert answer.status == 403
    assert answer.text.startswith("wrong host")


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:3000"},  # another server of this machine
        {"origin": "https://127.0.0.1:PORT"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"},
    ],
)
def test_another_page_is_refused(server, headers):
    told = {name: value.replace("PORT", str(server.port)) for name, value in headers.items()}
    before = list(server.folder.iterdir())
    answer = server.ask("POST", "/sessions", "{}", headers=told)
    assert answer.status == 403
    assert answer.text.startswith("wrong origin")
    assert list(server.folder.iterdir()) == before


def test_the_page_itself_may_ask(server):
    headers = {"origin": f"http://127.0.0.1:{server.port}", "sec-fetch-site": "same-origin"}
    assert server.ask("POST", "/sessions", "{}", headers=headers).status == 200
    followed = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert server.ask("GET", "/", headers=followed).status == 200  # a link to it


def test_every_answer_is_sealed(server):
    for path in ("/", "/static/serve.js", "/s/none/state", "/nowhere", "/?token=wrong"):
        headers = server.ask("GET", path).headers
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "http" not in policy  # no host at all
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in headers


def test_it_listens_on_this_machine_alone(server):
    """No address of this machine but loopback has the port."""
    listening = Path("/proc/net/tcp")
    if not listening.exists():
        pytest.skip("only Linux tells in /proc who listens")
    rows = [line.split()[1] for line in listening.read_text().splitlines()[1:]]
    ours = [row for row in rows if int(row.partition(":")[2], 16) == server.port]
    assert {row.partition(":")[0] for row in ours} == {"0100007F"}  # 127.0.0.1


def test_the_pages_name_nothing_outside():
    import minimax_cal.webapp as webapp

    folder = Path(str(webapp.__file__)).parent
    for path in (p for p in folder.iterdir() if p.suffix in (".js", ".css", ".jinja")):
        text = path.read_text()
        assert "http:" not in text, path
        assert "https:" not in text, path


@pytest.mark.skipif(sys.platform == "win32", reason="the browser is a script of a shell")
def test_the_token_is_not_in_the_command_line_of_the_browser(tmp_path):
    """Whoever shares the machine may read command lines, but not a private file."""
    browser, heard = tmp_path / "browser", tmp_path / "heard"
    browser.write_text(f'#!/bin/sh\nprintf %s "$*" > {heard}.part && mv {heard}.part {heard}\n')
    browser.chmod(0o755)
    command = [sys.executable, "-m", "minimax_cal.cli", "serve", "--port", "0", "--folder"]
    process = subprocess.Popen(
        [*command, str(tmp_path / "sessions")], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, "BROWSER": str(browser)},
    )  # fmt: skip
    assert process.stdout
    try:
        url = process.stdout.readline().strip()
        end = time.monotonic() + PATIENCE
        while not heard.exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        said = heard.read_text()
        assert url.partition("token=")[2] not in said
        page = Path(said.removeprefix("file://"))
        assert stat.S_IMODE(page.stat().st_mode) == 0o600
        assert stat.S_IMODE(page.parent.stat().st_mode) == 0o700
        assert f'content="0; url={url}"' in page.read_text()
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
    assert not page.exists()
