import socket

import pytest

from imgcal.errors import InputError
from imgcal.live_page import Address, parse_address
from imgcal.live_page.address import check_token, is_loopback


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, Address("127.0.0.1", 8765)),
        ("9000", Address("127.0.0.1", 9000)),
        (":9000", Address("127.0.0.1", 9000)),
        ("0.0.0.0", Address("0.0.0.0", 8765)),
        ("rig-pc.local:80", Address("rig-pc.local", 80)),
        ("[::1]:9000", Address("::1", 9000)),
    ],
)
def test_addresses_are_read(text, expected):
    assert parse_address(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "a b",
        "1.2.3.4:99999",
        "99999999",
        "http://127.0.0.1",
        "host:port",
        "1:2:3",
        "x" * 300 + ":",
        "a..b:9000",
        "x" * 64,
    ],
)
def test_what_is_no_address_is_one_line(text):
    with pytest.raises(InputError, match=r"expected \[HOST:\]PORT"):
        parse_address(text)


def test_where_no_port_is_usual_one_must_be_given():
    assert parse_address("9100", "--metrics", None) == Address("127.0.0.1", 9100)
    for text in ("", "a:b", "1:70000", "-5", ":", "127.0.0.1"):
        with pytest.raises(InputError, match=r"^--metrics: found .* expected \[HOST:\]PORT"):
            parse_address(text, "--metrics", None)


def test_only_loopback_is_local():
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.9.9.9", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "10.0.0.1", "localhost.example.org", ""))


def test_an_address_that_is_taken_says_so():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"127.0.0.1:{port}: Address already in use"):
            Address("127.0.0.1", port).listen()


def test_tokens_are_long_and_fit_into_an_address():
    first, second = check_token(None), check_token(None)
    assert first != second and len(first) >= 32 and check_token(first) == first
    for bad in ("short", "x" * 15, "x" * 129, "with space and more", "ümläut-is-not-ascii"):
        with pytest.raises(InputError, match="expected 16 to 128"):
            check_token(bad)


def test_the_url_has_the_token_only_where_it_is_given():
    assert Address("127.0.0.1", 80).url() == "http://127.0.0.1:80/"
    assert Address("::1", 80).url("abc") == "http://[::1]:80/?token=abc"
    assert Address("0.0.0.0", 80).url("abc") == f"http://{socket.gethostname()}:80/?token=abc"
