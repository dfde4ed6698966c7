"""Which orchestrator a command speaks to, and with whose token."""

import pytest
import typer

from skytether.cli.connection import connected, local_token, local_url, transport


@pytest.fixture
def state(tmp_path, monkeypatch):
    for name in ("SKYTETHER_TOKEN", "SKYTETHER_CA_FILE", "SKYTETHER_INSECURE_HTTP"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("skytether.cli.connection.default_state_dir", lambda: tmp_path)
    return tmp_path


def test_a_file_goes_before_the_environment_and_that_before_this_machines_token(state, tmp_path, monkeypatch):
    (state / "operator.token").write_text("of-this-machine\n")
    assert local_token(None) == "of-this-machine"
    monkeypatch.setenv("SKYTETHER_TOKEN", " of-the-environment ")
    assert local_token(None) == "of-the-environment"
    (tmp_path / "given").write_text("of-the-file\n")
    assert local_token(tmp_path / "given") == "of-the-file"


def test_the_orchestrator_of_this_machine_says_where_it_is(state):
    assert local_url() == "http://127.0.0.1:8600"
    (state / "address").write_text("http://127.0.0.1:9001\n")
    assert local_url() == "http://127.0.0.1:9001"


def test_plain_http_leaves_this_machine_only_where_that_is_allowed(state):
    assert transport(None)["insecure_http"]
    assert not transport("http://elsewhere:8600")["insecure_http"]


@pytest.mark.parametrize("content", [None, b"\xff\xfe"])
def test_a_token_file_that_cannot_be_read_is_one_sentence(state, tmp_path, capsys, content):
    path = tmp_path / "mine"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(typer.Exit) as ended, connected("http://127.0.0.1:1", path):
        pass
    assert ended.value.exit_code == 2
    said = capsys.readouterr().err.replace("\n", " ")
    assert ("there is no token file" if content is None else "it is no text") in said
