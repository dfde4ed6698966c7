import json
import signal
import socket
import subprocess
import sys

import pytest
import typer
import yaml
from typer.testing import CliRunner

from skytether.cli.commands.relay import relay

app = typer.Typer()
app.command()(relay)

ID = "00000000000000ff"


@pytest.fixture
def run(tmp_path):
    """Runs the command with options, or with a configuration."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def invoke(*options, config=None):
        if config is not None:
            path = tmp_path / "relay.yaml"
            path.write_text(yaml.safe_dump(config))
            options = ("--config", str(path), *options)
        return CliRunner().invoke(app, list(options))

    yield invoke
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.slow
def test_json_lines_tell_what_is_forwarded(run):
    config = {
        "listen": {"host": "127.0.0.1"},
        "routes": [{"id": ID, "target": {"host": "127.0.0.1", "port": 9}}],
        "limits": {"rate_mbps": 5},
    }
    result = run("--seconds", "1.2", "--json", config=config)
    assert result.exit_code == 0, result.output
    documents = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(documents) == 2
    assert documents[0]["sessions"] == {}
    assert documents[0]["legs"] == 0
    assert "listens on UDP 127.0.0.1:" in result.stderr


def test_people_read_a_sentence(run):
    result = run("--listen", "127.0.0.1:0", "--upstream", "127.0.0.1:9", "--seconds", "0.2")
    assert result.exit_code == 0, result.output
    assert "0 sessions, 0 addresses; packets dropped: none" in result.stderr
    assert not result.stdout


TARGET = {"host": "127.0.0.1", "port": 9}


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({}, "name at least one route, or an upstream"),
        ({"upstream": TARGET, "rotues": []}, "rotues: unknown key, did you mean 'routes'?"),
        ({"routes": [{"id": "ff", "target": TARGET}]}, "routes.0.id: 'ff' must be a session's 16 hexadecimal digits"),
        ({"routes": [{"id": ID}]}, "routes.0.target: is missing"),
        ({"routes": [{"id": ID, "target": {"host": "h", "port": 0}}]}, "routes.0.target.port: input should be greater"),
        ({"routes": [{"id": x, "target": TARGET} for x in ("ab*", "AB*")]}, "routes.1.id: 'AB*' is listed twice"),
        ({"routes": [{"id": "*", "target": TARGET}], "upstream": TARGET}, "upstream: there is a route '*'"),
        ({"upstream": TARGET, "limits": {"rate": 1}}, "limits.rate: unknown key, did you mean 'rate_mbps'?"),
        ({"upstream": TARGET, "limits": {"rate_mbps": 0}}, "limits.rate_mbps: input should be greater than 0"),
    ],
)
def test_a_mistake_in_the_configuration_names_its_key(run, config, says):
    result = run(config=config)
    assert result.exit_code == 2
    assert says in result.stderr


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--upstream", "nowhere"], "--upstream: 'nowhere' must be HOST:PORT with a port of 0 to 65535"),
        (["--upstream", "::1:70"], "[ADDRESS]:PORT for IPv6"),
        (["--listen", "h:99999", "--upstream", "h:1"], "--listen: 'h:99999' must be HOST:PORT"),
        (["--route", f"{ID}=x"], f"--route {ID}: 'x' must be HOST:PORT"),
        (["--route", "zz=h:1"], "'zz' must be a session's 16 hexadecimal digits"),
        (["--config", "relay.yaml", "--upstream", "h:1"], "either --config or"),
        (["--config", "no-such.yaml"], "cannot read no-such.yaml: No such file or directory"),
    ],
)
def test_a_mistake_in_the_options_is_one_sentence(run, options, says):
    result = run(*options)
    assert result.exit_code == 2
    assert says in result.stderr


def test_a_taken_port_and_an_unknown_target_are_one_sentence_each(run):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        result = run("--listen", f"127.0.0.1:{port}", "--upstream", "127.0.0.1:9")
        assert result.exit_code == 1
        assert f"cannot listen on UDP 127.0.0.1:{port}: Address already in use" in result.stderr
    result = run("--listen", "127.0.0.1:0", "--upstream", "no.such.host.invalid:9")
    assert result.exit_code == 1
    assert "target no.such.host.invalid:9 has no address" in result.stderr


@pytest.mark.slow
def test_the_program_ends_on_a_signal():
    code = "import typer; from skytether.cli.commands.relay import relay; typer.run(relay)"
    options = ["--listen", "127.0.0.1:0", "--route", f"{ID}=[::1]:9", "--upstream", "127.0.0.1:9"]
    with subprocess.Popen([sys.executable, "-c", code, *options], stderr=subprocess.PIPE, text=True) as process:
        try:
            assert "listens on UDP 127.0.0.1:" in process.stderr.readline()
            process.send_signal(signal.SIGTERM)
            assert process.wait(5) == 0
        finally:
            process.kill()
