from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.config.sources import example, leaves, load, page, seen_by_others
from skytether.orchestrator.domain.errors import InvalidError

DOCS = Path(__file__).parents[3] / "docs"


def test_the_command_line_goes_before_the_environment_and_that_before_the_file(tmp_path: Path) -> None:
    file = tmp_path / "orchestrator.yaml"
    file.write_text("host: file\nport: 1\nlimits: {body_bytes: 7, log_lines: 9}\n")
    environment = {"SKYTETHER_HOST": "environment", "SKYTETHER_LIMITS_BODY_BYTES": "8", "SKYTETHER_URL": "ignored"}
    settings = load(file, environment, {"port": 2, "host": None})
    assert (settings.host, settings.port) == ("environment", 2)
    assert (settings.limits.body_bytes, settings.limits.log_lines) == (8, 9)


def test_the_example_is_the_defaults_and_has_every_key(tmp_path: Path) -> None:
    file = tmp_path / "orchestrator.yaml"
    file.write_text(example())
    assert load(file, {}, {}) == Settings()
    document = yaml.safe_load(example())
    for path, field in leaves(Settings):
        inner = document
        for key in path:
            inner = inner[key]
        assert field.description, f"{path} is not documented"


def test_the_page_of_the_documentation_is_the_one_that_is_made() -> None:
    assert (DOCS / "configuration.md").read_text() == page(), "run `make docs`"


@pytest.mark.parametrize(
    ("text", "environment", "says"),
    [
        ("prot: 1", {}, "prot: unknown key, did you mean 'port'?"),
        ("limits: {body_byte: 1}", {}, "limits.body_byte: unknown key, did you mean 'body_bytes'?"),
        ("timing: {place: .nan}", {}, "timing.place: input should be a finite number"),
        ("port: 70000", {}, "port: input should be less than or equal to 65535"),
        ("timing: {place: 0}", {}, "timing.place: input should be greater than 0"),
        ("tls: {key: a}", {}, "tls: certificate and key belong together"),
        ("proxies: [127.0.0.1, gateway]", {}, "proxies: 'gateway' is no address and no network such as 10.0.0.0/24"),
        ("logs: {format: xml}", {}, "logs.format: input should be 'text' or 'json'"),
        ("limits: 3", {"SKYTETHER_LIMITS_EVENTS": "4"}, "limits: must be a mapping"),
        ("- 1", {}, "must hold one document of keys"),
        ("a: 1\na: 2", {}, "comes twice"),
        ("", {"SKYTETHER_PORT": "many"}, "port: input should be a valid integer"),
        ("", {"SKYTETHER_PORT": "[1"}, "SKYTETHER_PORT: is no value"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, environment: dict[str, str], says: str) -> None:
    file = tmp_path / "orchestrator.yaml"
    file.write_text(text)
    with pytest.raises(InvalidError, match=r".") as caught:
        load(file, environment, {})
    assert says in str(caught.value)


def test_a_file_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InvalidError, match="cannot read"):
        load(tmp_path / "none.yaml", {}, {})


def test_a_password_in_the_database_address_is_not_shown() -> None:
    assert "hunter2" not in repr(load(None, {"SKYTETHER_DATABASE_URL": "postgresql://a:hunter2@b/c"}, {}))


def test_a_password_that_others_can_read_is_told(tmp_path: Path) -> None:
    secret = "postgresql://me:hidden@host/name"
    told = seen_by_others(None, {"database_url": secret})
    assert "among the arguments: write it into a file with mode 0600 (?passfile=FILE" in told
    assert seen_by_others(None, {"database_url": "postgresql://me@host/name?password=hidden"})
    assert not seen_by_others(None, {"database_url": "postgresql://me@host/name?passfile=/x"})
    assert not seen_by_others(None, {"database_url": None})
    assert not seen_by_others(None, {"database_url": "postgresql://[me@host"})
    file = tmp_path / "orchestrator.yaml"
    file.write_text(f"database_url: {secret}\n")
    file.chmod(0o644)
    assert f"in {file}: chmod 600 it" in seen_by_others(file, {})
    file.chmod(0o640)
    assert not seen_by_others(file, {})
    file.write_text("port: 1\n")
    file.chmod(0o644)
    assert "hidden" not in told + seen_by_others(file, {})
