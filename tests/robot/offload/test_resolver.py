import socket
import threading

import pytest

from skytether.robot.offload.resolver import Resolver


def test_an_address_is_given_back_and_nobody_asked():
    resolver = Resolver(ask=lambda host: pytest.fail("asked"))
    assert resolver.address("127.0.0.1", 8600) == ("127.0.0.1", 8600)
    assert resolver.address("::1", 8600) == ("::1", 8600)


def test_a_name_is_asked_for_anew_each_time():
    answers = iter(["192.0.2.1", "192.0.2.2"])
    resolver = Resolver(ask=lambda host: next(answers))
    assert resolver.address("service.example", 1) == ("192.0.2.1", 1)
    assert resolver.address("service.example", 2) == ("192.0.2.2", 2)


def test_what_has_no_address_is_told_with_its_reason():
    def ask(host):
        raise socket.gaierror(-2, "Name or service not known")

    with pytest.raises(ValueError, match=r"service\.example has no address: Name or service not known"):
        Resolver(ask=ask).address("service.example", 1)
    with pytest.raises(ValueError, match="has no address"):
        Resolver().address("a" * 80 + ".example", 1)


def test_a_name_server_that_does_not_answer_is_not_waited_for_but_its_late_answer_counts():
    answer, asked = threading.Event(), []

    def ask(host):
        asked.append(host)
        answer.wait(30)
        return "192.0.2.1"

    resolver = Resolver(0.01, ask)
    for _ in range(3):
        with pytest.raises(ValueError, match="the name server does not answer"):
            resolver.address("service.example", 1)
    assert asked == ["service.example"]
    for i in range(10):
        with pytest.raises(ValueError, match="does not answer"):
            resolver.address(f"{i}.example", 1)
    assert len(asked) == 8
    answer.set()
    for thread in threading.enumerate():
        if thread.name == "resolver":
            thread.join(30)
    assert resolver.address("service.example", 1) == ("192.0.2.1", 1)
    assert asked.count("service.example") == 1, "the late answer was there"
