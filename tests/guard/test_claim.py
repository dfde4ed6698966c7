"""The folder of a guard: whoever has it, and whether it still leads to the guard."""

import pytest

from skytether.guard.claim import LOCK_FILE, Claim, ClaimError


@pytest.fixture
def claim(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "stop.sock").touch()
    claim = Claim(str(tmp_path / "run"))
    claim.add(str(tmp_path / "run" / "stop.sock"))
    claim.look()
    assert not claim.lost
    return claim


@pytest.mark.parametrize("name", [LOCK_FILE, "stop.sock"])
@pytest.mark.parametrize("again", [False, True])
def test_a_file_that_is_removed_or_replaced_is_a_folder_that_is_lost(claim, tmp_path, name, again):
    file = tmp_path / "run" / name
    file.rename(tmp_path / "kept")  # so that its inode is not given to the next file
    if again:
        file.touch()
    claim.look()
    assert claim.lost == str(file)


def test_a_folder_that_is_replaced_is_lost(claim, tmp_path):
    (tmp_path / "run").rename(tmp_path / "old")
    claim.look()
    assert claim.lost


def test_a_folder_has_one_guard(claim, tmp_path):
    with pytest.raises(ClaimError, match="another gate runs"):
        Claim(str(tmp_path / "run"))
    (tmp_path / "file").touch()
    with pytest.raises(ClaimError, match="cannot use the folder"):
        Claim(str(tmp_path / "file"))
