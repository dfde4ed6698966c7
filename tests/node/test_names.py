"""An engine's lookups of names, which may load a library out of an image."""

from pathlib import Path

import pytest

from skytether.node.names import loads_late

ROOT, DOCKER = "root:x:0:0:root:/root:/bin/bash\n", "docker:x:1000:1000::/home/docker:/bin/sh\n"


@pytest.mark.parametrize(
    ("switch", "users", "late"),
    [
        (None, ROOT, None),
        (None, ROOT + DOCKER, None),
        ("passwd: files systemd\ngroup: files systemd\n", ROOT, None),
        ("passwd: files systemd\ngroup: files [SUCCESS=merge] systemd # and so on\n", ROOT, None),
        ("passwd: files systemd\ngroup: files systemd\n", ROOT + DOCKER, "systemd"),
        ("passwd: sss files\ngroup: sss files\n", ROOT + DOCKER, None),
        ("passwd: sss files systemd\ngroup: sss files\n", ROOT + DOCKER, "systemd"),
        ("passwd: files\ngroup: files ldap\n", ROOT, "ldap"),
        ("passwd: compat\ngroup: compat\n", ROOT + DOCKER, "compat"),
    ],
)
def test_what_an_engine_would_load_out_of_an_image(
    tmp_path: Path, switch: str | None, users: str, late: str | None
) -> None:
    if switch is not None:
        (tmp_path / "switch").write_text(switch)
    (tmp_path / "users").write_text(users)
    said = loads_late(tmp_path / "switch", tmp_path / "users")
    assert said is None if late is None else f"would load libnss_{late} out of an image: " in str(said)
