import hmac

import pytest

from imgcal.live_page import Address, Gate
from imgcal.live_page.security import Allowance

TOKEN = "a-token-of-this-test"
LOCAL, REMOTE = Gate(Address("127.0.0.1", 8765), TOKEN), Gate(Address("0.0.0.0", 8765), TOKEN)
HOST = "127.0.0.1:8765"


def refused(gate, method="GET", path="/", host=HOST, **headers):
    given = {name.replace("_", "-"): [value] for name, value in headers.items()}
    refusal = gate.refusal(method, path, given | ({} if host is None else {"host": [host]}))
    return None if refusal is None else refusal.status


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "localhost:8765", "LOCALHOST:9000", "[::1]:8765", "127.0.0.1"])
def test_names_of_this_machine_are_known(host):
    assert refused(LOCAL, host=host) is None


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:8765", "127.0.0.1.evil.example", "localhost.evil.example:8765", "10.0.0.1:8765",
        "", "127.0.0.1:8765@evil.example", "a b", "127.0.0.1:8765:1", "[::1", "0x7f.1", None,
    ],
)  # fmt: skip
def test_another_name_that_points_here_is_refused(host):
    """DNS rebinding: the browser takes us for the server of that name."""
    assert refused(LOCAL, host=host) == 421
    assert refused(LOCAL, "POST", "/command", host=host, x_imgcal_token=TOKEN) == 421


def test_two_hosts_are_none():
    assert LOCAL.refusal("GET", "/", {"host": [HOST, HOST]}).status == 421


def test_elsewhere_only_plain_addresses_and_own_names_are_known():
    assert REMOTE.knows("192.168.1.7:8765") and REMOTE.knows("[fe80::1]:8765") and REMOTE.knows("localhost:8765")
    assert not REMOTE.knows("evil.example:8765")


def test_a_machine_whose_name_has_an_underscore_knows_the_address_that_it_prints(monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "lab_pc")
    host = REMOTE.address.url().removeprefix("http://").rstrip("/")
    assert host == "lab_pc:8765" and REMOTE.knows(host)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:3000", "https://127.0.0.1:8765", ""]
)
def test_pages_of_another_origin_are_refused(origin):
    assert refused(LOCAL, origin=origin) == 403
    assert refused(LOCAL, "POST", "/command", origin=origin, x_imgcal_token=TOKEN) == 403
    assert refused(LOCAL, "POST", "/command", origin=f"http://{HOST}", x_imgcal_token=TOKEN) is None


def test_other_sites_may_link_here_and_nothing_else():
    assert refused(LOCAL, sec_fetch_site="cross-site", sec_fetch_mode="navigate") is None
    assert refused(LOCAL, sec_fetch_site="cross-site", sec_fetch_mode="no-cors") == 403
    assert refused(LOCAL, path="/stream", sec_fetch_site="same-site") == 403
    assert refused(LOCAL, path="/rig.yaml", sec_fetch_site="cross-site", sec_fetch_mode="navigate") == 403
    assert refused(LOCAL, path="/stream", sec_fetch_site="same-origin") is None


@pytest.mark.parametrize("token", [None, "", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), "ü" * 20])
def test_commands_need_the_token_on_this_machine_too(token):
    given = {} if token is None else {"x_imgcal_token": token}
    assert refused(LOCAL, "POST", "/command", **given) == 403
    assert refused(LOCAL, "POST", "/command", x_imgcal_token=TOKEN) is None


def test_from_elsewhere_everything_needs_the_token():
    for path in ("/", "/stream", "/rig.yaml", "/nothing"):
        assert refused(LOCAL, path=path) is None
        assert refused(REMOTE, path=path) == 401
        assert refused(REMOTE, path=path, cookie="imgcal-8765=wrong") == 401
        assert refused(REMOTE, path=path, cookie=f"a=b; imgcal-8765={TOKEN}") is None
        assert refused(REMOTE, path=path, authorization=f"Bearer {TOKEN}") is None
    assert refused(REMOTE, cookie=f"imgcal-9000={TOKEN}") == 401
    assert refused(REMOTE, cookie="\x00;;==" * 50) == 401
    assert refused(REMOTE, "POST", "/command", cookie=f"imgcal-8765={TOKEN}") == 403
    assert REMOTE.token_of_query(f"token={TOKEN}") and not REMOTE.token_of_query("token=" + "&token=" * 9)
    assert not REMOTE.token_of_query(f"token={TOKEN}&token={TOKEN}")


@pytest.mark.parametrize("other", ['prefs={"a":1}', "seen", "a b=c", "=", '"', "imgcal-9000=wrong"])
def test_cookies_of_other_ports_do_not_hide_the_token(other):
    for cookies in (f"{other}; imgcal-8765={TOKEN}", f"imgcal-8765={TOKEN}; {other}", f"{other};imgcal-8765={TOKEN}"):
        assert refused(REMOTE, cookie=cookies) is None
    assert refused(REMOTE, cookie=other) == 401


def test_tokens_are_compared_in_constant_time(monkeypatch):
    compared = []
    monkeypatch.setattr(hmac, "compare_digest", lambda *pair: compared.append(pair) or False)
    assert refused(LOCAL, "POST", "/command", x_imgcal_token=TOKEN) == 403
    assert refused(REMOTE, cookie=f"imgcal-8765={TOKEN}") == 401
    assert not REMOTE.token_of_query(f"token={TOKEN}")
    assert compared == [(TOKEN.encode(), TOKEN.encode())] * 3


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "TRACE", "get"])
def test_other_methods_are_refused(method):
    assert refused(LOCAL, method) == 405


def test_an_allowance_is_used_up_and_comes_back(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("imgcal.live_page.security.time.monotonic", lambda: now[0])
    allowance = Allowance(3, 2.0)
    assert [allowance.try_take() for _ in range(4)] == [True, True, True, False]
    now[0] = 0.6
    assert [allowance.try_take() for _ in range(2)] == [True, False]
    now[0] = 100.0
    assert sum(allowance.try_take() for _ in range(9)) == 3
