from pathlib import Path

import pytest

from skytether.api.yaml import YamlError, read_yaml


def test_all_documents_are_read_and_merges_may_repeat_keys(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("x: &x {a: 1}\ny: {<<: *x, a: 2}\n---\n---\n[1]\n")
    assert read_yaml(path) == [{"x": {"a": 1}, "y": {"a": 2}}, [1]]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"a: 1\nb: 2\na: 3\n", "is no YAML in line 3: the key 'a' comes twice"),
        (b"spec: {entrypoint: x, entrypoint: y}", "is no YAML in line 1: the key 'entrypoint' comes twice"),
        (b"a:\n\tb: 1\n", "is no YAML in line 2: found character"),
        (b"a: \x80", "is no YAML"),
        (b"a: 2001-99-99", "is no YAML"),
        (b"[" * 700, "is no YAML: it is no text"),  # deeper than Python calls,
        (b"x" * (1 << 20) + b"x", "is larger than 1048576 bytes"),
        (b"a: &a {b: [*a]}", "an alias stands for what it is part of"),
        (
            b"a: &a [1, 1, 1, 1]\n"
            + b"".join(b"%c: &%c [%s]\n" % (n, n, b", ".join([b"*%c" % (n - 1)] * 9)) for n in b"bcdefghi"),
            "an alias stands for what it is part of, or for far too much",
        ),
        (b"!!python/object/apply:os.system [ls]", "is no YAML in line 1"),
    ],
)
def test_what_is_none_is_told_by_line(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    with pytest.raises(YamlError) as caught:
        read_yaml(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    with pytest.raises(YamlError, match="cannot be read: No such file"):
        read_yaml(tmp_path / "none.yaml")
