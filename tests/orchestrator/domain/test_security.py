from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from skytether.orchestrator.domain.security import (
    SecretFileError,
    Secrets,
    TokenHash,
    close_folder,
    new_token,
    secret_file,
)


def test_a_token_has_256_random_bits() -> None:
    tokens = {new_token() for _ in range(100)}
    assert len(tokens) == 100
    assert all(re.fullmatch(r"sky-[0-9a-f]{64}", token) for token in tokens)


def test_what_is_kept_of_a_token_recognises_it_and_does_not_hold_it() -> None:
    token = new_token()
    kept = TokenHash.of(token)
    assert kept.matches(token)
    assert not kept.matches(new_token())
    assert not kept.matches(token[:-1])
    assert token.startswith(kept.prefix)
    assert token[len(kept.prefix) :] not in repr(kept)


def test_a_secret_file_is_made_once_and_for_its_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "key"
    made = secret_file(path, lambda: b"first")
    assert made == b"first"
    assert secret_file(path, lambda: b"second") == b"first"
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_secret_file_that_others_can_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(b"seen")
    path.chmod(0o640)
    with pytest.raises(SecretFileError, match="chmod 600"):
        secret_file(path, lambda: b"new")


def test_an_empty_secret_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.touch(mode=0o600)
    with pytest.raises(SecretFileError, match="is empty: delete it"):
        secret_file(path, lambda: b"new")


def test_a_secret_file_that_cannot_be_used_is_told(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(SecretFileError, match="folder: Is a directory"):
        secret_file(tmp_path / "folder", lambda: b"new")
    with pytest.raises(SecretFileError, match="none/key: No such file"):
        secret_file(tmp_path / "none" / "key", lambda: b"new")


def test_a_folder_for_secrets_is_made_and_is_nobody_elses(tmp_path: Path) -> None:
    Secrets(tmp_path / "shared" / "secrets")
    assert (tmp_path / "shared" / "secrets").stat().st_mode & 0o777 == 0o700
    (tmp_path / "file").touch()
    with pytest.raises(SecretFileError, match=r"cannot make the folder .*file for secrets"):
        Secrets(tmp_path / "file")


def test_a_folder_into_which_anybody_may_put_another_token_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "secrets"
    Secrets(folder)
    folder.chmod(0o777)
    with pytest.raises(SecretFileError, match=r"others may put secrets of their own into .*: chmod o-w"):
        Secrets(folder)
    folder.chmod(0o1777)  # where nobody can take away what is there, as Kubernetes mounts secrets
    Secrets(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user too")
def test_a_folder_that_another_user_made_where_all_may_is_not_taken(tmp_path: Path) -> None:
    """Whose it is may replace the operator's token at any time."""
    tmp_path.chmod(0o1777)
    theirs = tmp_path / "skytether"
    theirs.mkdir(mode=0o700)
    os.chown(theirs, 54_321, 54_321)
    for take in (Secrets, lambda folder: close_folder(folder, with_database=True)):
        with pytest.raises(SecretFileError, match="skytether belongs to the user 54321, who may have made it"):
            take(theirs)
    assert list(theirs.iterdir()) == []
    tmp_path.chmod(0o755)
    Secrets(theirs)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user too")
@pytest.mark.parametrize("name", ["operator.token", "secret.key"])
def test_a_secret_that_another_user_put_there_is_refused(tmp_path: Path, name: str) -> None:
    """Who came first to a folder in which everybody may make files, and is read by root all the same."""
    folder = tmp_path / "secrets"
    Secrets(folder)
    folder.chmod(0o1777)
    os.chown(folder / name, 54_321, 54_321)
    with pytest.raises(SecretFileError, match=f"{name} belongs to the user 54321"):
        Secrets(folder)
    os.chown(folder, 54_321, 54_321)  # all of it is theirs, and so is the orchestrator that root runs on it
    Secrets(folder)


@pytest.mark.parametrize("name", ["operator.token", "secret.key"])
def test_a_secret_that_was_cut_off_is_refused(tmp_path: Path, name: str) -> None:
    """Whoever tries all that are as short finds it."""
    Secrets(tmp_path)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:15])
    with pytest.raises(SecretFileError, match=f"{name} has 15 bytes, too few for a secret: put all of it back"):
        Secrets(tmp_path)


def test_an_operators_token_that_is_none_is_told(tmp_path: Path) -> None:
    path = tmp_path / "operator.token"
    path.touch(mode=0o600)
    path.write_bytes(b"\xff\xfe" * 16)
    with pytest.raises(SecretFileError, match="holds no token: delete it"):
        Secrets(tmp_path)


def test_session_keys_are_the_same_after_a_restart_and_differ_by_session_and_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    key = Secrets(tmp_path / "a").session_key("0011223344556677")
    assert len(key) == 32
    assert Secrets(tmp_path / "a").session_key("0011223344556677") == key
    assert Secrets(tmp_path / "a").session_key("0011223344556678") != key
    assert Secrets(tmp_path / "b").session_key("0011223344556677") != key


def test_the_operators_token_is_in_its_file(tmp_path: Path) -> None:
    secrets = Secrets(tmp_path)
    token = (tmp_path / "operator.token").read_text().strip()
    assert secrets.is_operator(token)
    assert not secrets.is_operator(new_token())
    assert token not in repr(vars(secrets))
