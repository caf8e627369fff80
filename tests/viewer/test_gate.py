from __future__ import annotations

import socket

import pytest

from mrgs.viewer.web import Gate


@pytest.fixture
def gate() -> Gate:
    return Gate("127.0.0.1")


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "127.0.0.1", "localhost:9999", "LOCALHOST", "[::1]:8080"]
)
def test_this_computers_own_names_are_known(gate, host):
    assert gate.is_own_host([host])


@pytest.mark.parametrize(
    "hosts",
    [
        ["evil.example"],
        ["evil.example:8080"],
        ["127.0.0.1.evil.example"],
        ["localhost.evil.example:8080"],
        ["192.168.0.7:8080"],
        ["evil@127.0.0.1"],
        ["127.0.0.1/evil.example"],
        ["127.0.0.1:http"],
        ["["],
        [""],
        [],
        ["127.0.0.1", "evil.example"],
    ],
)
def test_any_other_host_is_foreign(gate, hosts):
    assert not gate.is_own_host(hosts)


def test_on_the_network_addresses_are_own_and_names_are_not():
    """A name can be pointed anywhere by its owner, an address cannot."""
    gate = Gate("0.0.0.0")
    assert gate.is_own_host(["192.168.0.7:8080"])
    assert gate.is_own_host([f"{socket.gethostname()}:8080"])
    assert not gate.is_own_host(["evil.example:8080"])


def test_where_only_this_computer_is_served_its_name_in_the_network_is_foreign():
    office = socket.gethostname().swapcase()
    if office == "LOCALHOST":
        pytest.skip("this computer has no name in the network")
    assert not Gate("127.0.0.1").is_own_host([f"{office}:8080"])
    assert not Gate("localhost").is_own_host([f"{office}:8080"])
    assert not Gate("localhost").is_own_host(["192.168.0.7:8080"])
    assert Gate("192.168.0.7").is_own_host([f"{office}:8080"])
    assert Gate("Office.example").is_own_host(["office.example:8080"])


@pytest.mark.parametrize(
    ("origins", "own"),
    [
        ([], True),  # a program
        (["http://127.0.0.1:8080"], True),
        (["https://127.0.0.1:8080"], True),
        (["http://127.0.0.1:8081"], False),
        (["http://localhost:8080"], False),
        (["http://evil.example"], False),
        (["http://evil.example:8080"], False),
        (["null"], False),
        (["http://127.0.0.1:8080", "http://evil.example"], False),
    ],
)
def test_only_the_servers_own_page_may_ask(gate, origins, own):
    assert gate.is_own_origin(origins, ["127.0.0.1:8080"]) == own


def test_the_token_is_the_servers_own(gate):
    assert gate.knows(gate.token)
    assert len(gate.token) >= 32
    assert not any(
        gate.knows(other) for other in (None, "", "é", gate.token[:-1], gate.token + "x")
    )
    assert gate.token != Gate("127.0.0.1").token


def test_the_token_is_found_in_address_and_cookie(gate):
    assert gate.token_in(f"/?a=1&token={gate.token}") == gate.token
    assert gate.token_in("/?tok=1") is None
    name = gate.cookie(8080).partition("=")[0]
    assert gate.has_cookie(["other=1", f"{name}={gate.token}"], 8080)
    assert not gate.has_cookie([f"{name}={gate.token}"], 8081)
    for other in ('prefs={"theme":"dark","n":1}', "x[y]=1", "abc", 'q="a', "=;;"):
        for jar in ([f"{other}; {name}={gate.token}"], [f"{name}={gate.token};{other}"]):
            assert gate.has_cookie(jar, 8080)
    for jar in ([f"other={gate.token}"], [f"x{name}={gate.token}"]):
        assert not gate.has_cookie(jar, 8080)
    for jar in ([], [f"{name}=wrong"], ["\x00;;;=", f"{name}"]):
        assert not gate.has_cookie(jar, 8080)
    assert {"HttpOnly", "SameSite=Strict"} <= set(gate.cookie(8080).split("; "))
