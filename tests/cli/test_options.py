"""``--option KEY=VALUE``."""

import pytest
import typer

from skytether.cli.options import options_of, value_of


@pytest.mark.parametrize(
    ("text", "value"),
    [("3", 3), ("true", True), ("[20000, 20099]", [20000, 20099]), ("a: b: c", "a: b: c"), ("x=y", "x=y"), ("", None)],
)
def test_a_value_is_what_yaml_reads_and_else_text(text, value):
    assert value_of(text) == value


def test_each_option_has_a_key_and_a_value(capsys):
    assert options_of(["cpu=2", "note=a=b"]) == {"cpu": 2, "note": "a=b"}
    assert options_of(None) == {}
    with pytest.raises(typer.Exit) as ended:
        options_of(["cpu"])
    assert ended.value.exit_code == 2
    assert "--option cpu: write KEY=VALUE" in capsys.readouterr().err
