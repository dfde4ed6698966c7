"""What runtimes of containers have in common."""

from __future__ import annotations

from pathlib import Path

import pytest

from skytether.orchestrator.runtimes.containers import (
    data_name,
    exit_status,
    is_pulled,
    kept_owner,
    last_line,
    with_owner,
)


@pytest.mark.parametrize(
    ("image", "pulled"),
    [
        ("skytether/navigation:1", False),
        ("docker.io/skytether/navigation:1", False),
        ("index.docker.io/skytether/navigation:1", False),
        ("skytether/navigation@sha256:" + 64 * "a", True),
        ("registry.example/skytether/navigation:1", True),
        ("docker.io/library/debian", True),
    ],
)
def test_no_registry_is_asked_for_the_names_of_our_own_images(image: str, pulled: bool) -> None:
    assert is_pulled(image) is pulled


@pytest.mark.parametrize(
    ("code", "status"), [(0, 0), (1, 1), (128, 128), (137, -9), (143, -15), (192, -64), (255, 255)]
)
def test_an_exit_by_a_signal_is_negative(code: int, status: int) -> None:
    assert exit_status(code) == status


def test_no_two_robots_and_services_share_a_name_of_data() -> None:
    pairs = [("a-b", "c"), ("a", "b-c"), ("a", "b"), ("ab", "c"), ("a", "bc")]
    assert len({data_name("me", *pair) for pair in pairs}) == len(pairs)
    assert data_name("me", "a", "b") == "skytether-me-data-a-b"


def test_an_owner_is_made_up_once(tmp_path: Path) -> None:
    assert kept_owner(tmp_path) == kept_owner(tmp_path)
    assert with_owner({"owner": "mine"}) == {"owner": "mine"}
    assert with_owner({})["owner"] != with_owner({})["owner"]


def test_the_last_line_is_the_last_that_can_be_read_and_not_long() -> None:
    assert last_line("one\ntwo \x1b\n\n \x00\n") == "two"
    assert last_line("") == ""
    assert len(last_line("x" * 1000)) == 300
