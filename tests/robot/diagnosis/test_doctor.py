from datetime import UTC, datetime
from email.utils import format_datetime

import pytest

from skytether.robot.diagnosis import examine
from skytether.robot.diagnosis.doctor import (
    judge_certificate,
    judge_clock,
    judge_extras,
    judge_mtu,
    judge_nat,
    judge_udp,
)

NOON = 1_800_000_000.0


def date(at: float) -> str:
    return format_datetime(datetime.fromtimestamp(int(at), UTC), usegmt=True)


@pytest.mark.parametrize("theirs", [0.0, 0.9, -1.5, 1.5])
def test_clocks_that_agree_to_a_second_or_two_are_well(theirs):
    assert judge_clock(date(NOON + theirs), NOON, NOON + 0.3).state == "ok"


@pytest.mark.parametrize(("theirs", "says"), [(-3600.0, "3599 s ahead of"), (3600.0, "3600 s behind")])
def test_a_clock_that_is_off_is_told_with_its_way(theirs, says):
    found = judge_clock(date(NOON + theirs), NOON, NOON + 0.1)
    assert found.state == "trouble"
    assert says in found.says
    assert "timedatectl set-ntp true" in found.todo


def test_a_slow_answer_is_no_wrong_clock_and_no_date_says_nothing():
    assert judge_clock(date(NOON + 1), NOON, NOON + 30).state == "ok"
    assert judge_clock(None, NOON, NOON).state == "skipped"
    assert judge_clock("yesterday", NOON, NOON).state == "skipped"


@pytest.mark.parametrize(
    ("error", "says", "todo"),
    [
        ("certificate verify failed: self-signed certificate", "does not know", "--ca-file"),
        ("certificate verify failed: unable to get local issuer certificate", "does not know", "--ca-file"),
        ("certificate verify failed: certificate has expired", "expired", "renew it"),
        (
            "certificate verify failed: IP address mismatch, certificate is not valid for '10.0.0.1'",
            "another name",
            "use",
        ),
        ("something else", "something else", "tls.certificate"),
    ],
)
def test_certificates_are_judged_by_what_the_library_says(error, says, todo):
    found = judge_certificate("https://cloud", error)
    assert (found.state, says in found.says, todo in found.todo) == ("trouble", True, True)
    assert judge_certificate("https://cloud", "").state == "ok"


def test_udp_packet_size_and_nat():
    assert judge_udp("a:1", 10, 0).state == "trouble"
    assert judge_udp("a:1", 10, 4).state == "trouble"
    assert judge_udp("a:1", 10, 9).state == "ok"
    assert judge_mtu(None).state == "skipped"
    assert judge_mtu(1472).state == "ok"
    assert judge_mtu(900).says.endswith("the bridge uses smaller ones, at a cost")
    assert judge_mtu(400).says.endswith("too small for the bridge")
    assert judge_nat([("1.2.3.4", 5)] * 3).state == "ok"
    assert judge_nat([("1.2.3.4", 5)]).state == "skipped"
    assert "2 addresses in turn, 2 changes" in judge_nat([("1.2.3.4", 5), ("1.2.3.4", 6), ("1.2.3.4", 5)]).says


def test_extras_that_are_needed_and_missing():
    missing = {"ros2": ["zenoh"], "lab": ["matplotlib"], "docker": []}
    found = judge_extras(missing, ["ros2"])
    assert (found.state, found.todo) == ("trouble", "pip install 'skytether[ros2]'")
    assert judge_extras(missing, []).says == "what is needed is there; not installed, not needed: ros2, lab"


class Without:
    """Python as it is without a distribution."""

    def __init__(self, module):
        self._module = module

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == self._module:
            raise ModuleNotFoundError(f"No module named '{name}'")
        return


def test_a_module_that_is_not_installed_is_found_missing(monkeypatch):
    import sys

    monkeypatch.delitem(sys.modules, "zenoh", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Without("zenoh"), *sys.meta_path])
    assert examine.extras(["ros2"]).todo == "pip install 'skytether[ros2]'"


def test_a_fallback_that_cannot_be_had_is_trouble():
    assert examine.own_controller("stop", {}).says == "stop stops the robot when link or service fail"
    assert examine.own_controller("levitate", {}).state == "trouble"
