"""Requests to the server in its own process, as hostile pages and programs send them."""

import json
import socket
import time

import pytest

from imgcal.live_page import Address, Command, LivePage
from imgcal.live_page.server import MOST_BODY
from tests.imgcal.live_page.pages import Client, alarm, made_state


def fetched(page, count=1):
    """Wait for commands to come through."""
    found, end = [], time.monotonic() + 120
    while len(found) < count and time.monotonic() < end:
        found += page.commands()
        time.sleep(0.005)
    return found


def test_the_page_comes_with_headers_that_forbid_all_else(client):
    status, headers, text = client("GET", "/")
    assert status == 200 and text.startswith("<!doctype html>")
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
    for name in ("x-content-type-options", "x-frame-options", "referrer-policy", "cross-origin-resource-policy"):
        assert headers[name] in ("nosniff", "DENY", "no-referrer", "same-origin")
    assert "server" not in headers and headers["cache-control"] == "no-store"
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "") and "https://" not in text


def test_commands_come_through_once_they_are_what_they_must_be(served, client, stream):
    assert client.command({"name": "pause"})[0] == 200
    assert client.command({"name": "bump", "camera": 6})[0] == 200
    assert client.command({"name": "factory", "confirmed": True})[0] == 200
    assert fetched(served, 3) == [Command("pause"), Command("bump", "cam07"), Command("factory")]
    assert stream.wait("controls", lambda content: content["paused"])
    assert client.command({"name": "warm"})[0] == 200
    assert fetched(served) == [Command("warm")]  # or the next test finds it
    assert stream.wait("controls", lambda content: content["on"])["on"] == ["warm"]


def test_a_command_that_is_not_in_order_does_nothing(served, client):
    cases = [
        ({"name": "pause"}, {"X_Imgcal_Token": None}, 403),
        ({"name": "pause"}, {"X_Imgcal_Token": "wrong"}, 403),
        ({"name": "pause"}, {"Origin": "http://evil.example"}, 403),
        ({"name": "pause"}, {"Host": "evil.example"}, 421),
        ({"name": "pause"}, {"Sec_Fetch_Site": "cross-site"}, 403),
        ({"name": "pause"}, {"Content_Type": "text/plain"}, 415),
        ({"name": "pause"}, {"Content_Type": "application/x-www-form-urlencoded"}, 415),
        (b"{", {}, 400),
        (b"[" * 900, {}, 400),
        (b"\xff\xfe", {}, 400),
        ({"name": "factory"}, {}, 400),
        (b" " * (MOST_BODY + 1), {}, 413),
    ]
    for content, headers, expected in cases:
        assert client.command(content, **headers)[0] == expected, content
    assert client.command({"name": "resume"})[0] == 200
    assert fetched(served) == [Command("resume")]


def test_commands_are_not_taken_by_get(served, client):
    assert client("GET", "/command?name=pause")[0] == 405
    assert client("POST", "/", b"", X_Imgcal_Token=client.token())[0] == 405
    assert not served.commands()


@pytest.mark.parametrize(
    "path",
    ["/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/assets/main.js", "/page.html", "//etc/passwd", "/rig.yaml/",
     "/rig.yaml%00", "/" + "a" * 3000, "/imgcal/live_page/server.py", "/.git/config"],
)  # fmt: skip
def test_no_path_reaches_a_file(client, path):
    status, _, text = client("GET", path)
    assert status == 404 and "root:" not in text


def test_large_headers_and_broken_requests_end_with_the_connection(served, client):
    for bad in (b"GET / HTTP/1.1\r\nX: " + b"a" * 200_000 + b"\r\n\r\n", b"\x16\x03\x01\x02\x00" * 50, b"GET\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", served.address.port), timeout=10) as raw:
            try:
                raw.sendall(bad)
                assert raw.recv(1000).startswith((b"HTTP/1.1 4", b""))
            except ConnectionError:
                pass
    assert client("GET", "/")[0] == 200


def test_from_elsewhere_the_token_opens_the_door_and_says_so(o10, asymmetric8):
    with LivePage(o10, asymmetric8, Address("0.0.0.0", 0), token="a-token-of-this-test") as page:
        assert "?token=a-token-of-this-test" in page.url and "not encrypted" in page.notice
        client = Client(page)
        assert client("GET", "/")[0] == client("GET", "/stream")[0] == client("GET", "/rig.yaml")[0] == 401
        assert client("GET", "/?token=wrong-token-wrong")[0] == 401
        assert client("GET", "/?token=a-token-of-this-test", Host="evil.example")[0] == 421
        status, headers, _ = client("GET", "/?token=a-token-of-this-test")
        assert status == 303 and headers["location"] == "/"
        assert "HttpOnly" in headers["set-cookie"] and "SameSite=Strict" in headers["set-cookie"]
        cookie = headers["set-cookie"].partition(";")[0]
        assert client("GET", "/", Cookie=cookie)[0] == 200
        assert client("GET", "/nothing", Authorization="Bearer a-token-of-this-test")[0] == 404


def test_this_machine_alone_needs_no_token_to_look(served, client):
    assert served.address.local and "token" not in served.url and "this machine only" in served.notice
    assert client("GET", "/")[0] == 200


def test_the_stream_tells_all_then_what_is_new(served, stream, o10, asymmetric8):
    assert stream.wait("hello")["cameras"] == list(o10.camera_names)
    served.publish(made_state(o10, asymmetric8, 1, health={"cam07": "relearning"}, events=(alarm("cam07"),)))
    events = stream.wait("events", lambda content: content)
    assert events[0]["message"] == "cam07 turned 0.3 degrees" and events[0]["open"]
    assert stream.wait("state", lambda content: content["snapshot"] == 1)["health"][6] == "relearning"
    assert len(stream.wait("picture")["predicted"]) == 8


def test_alarms_are_acknowledged_for_everybody(served, client, stream, o10, asymmetric8):
    before = len(stream.wait("events"))
    served.publish(made_state(o10, asymmetric8, 2, events=(alarm("cam07"), alarm("cam02"))))
    assert len(stream.wait("events", lambda content: len(content) == before + 2)) == before + 2
    assert client.command({"name": "acknowledge", "event": before})[0] == 200
    assert [event["open"] for event in stream.wait("events", lambda content: not content[before]["open"])][-1]
    assert client.command({"name": "acknowledge", "event": before + 2})[0] == 400
    assert fetched(served) == [Command("acknowledge", event=before)]


def test_downloads_hold_the_present_rig_and_no_token(served, client, stream, o10, tmp_path):
    from imgcal.io import read_rig

    status, headers, text = client.download("/rig.yaml")
    assert status == 200
    assert headers["content-disposition"] == 'attachment; filename="rig.yaml"'
    (tmp_path / "rig.yaml").write_text(text)
    assert read_rig(tmp_path / "rig.yaml").camera_names == o10.camera_names
    status, _, report = client.download("/report.html")
    assert status == 200 and client.token() not in report
    data = json.loads(report.split('id="data">')[1].split("</script>")[0])
    assert data["contents"]["hello"]["rig"] == "O10" and data["contents"]["state"]["snapshot"] >= 0


def test_commands_and_downloads_are_rationed(served, client):
    answers = [client.command({"name": "pause"}, patient=False)[0] for _ in range(40)]
    assert 200 in answers and 429 in answers and set(answers) <= {200, 429}
    assert client.download("/report.html")[0] == 200  # what earlier tests took comes back
    assert 429 in [client("GET", "/report.html")[0] for _ in range(12)]
