"""Attacks on real processes: few here, each once; all of them are `skytether lab bench safety`."""

from __future__ import annotations

import pytest

from skytether.lab.bench.safety import attacks, estimate, select


def test_each_attack_has_a_name_of_its_own_and_can_be_chosen():
    names = [attack.name for attack in attacks()]
    assert len(names) == len(set(names))
    assert all(attack.what and attack.seconds > 0 for attack in attacks())
    for name in names:
        assert name in [attack.name for attack in select([name])]
    assert [attack.name for attack in select(["stop-reason"])] == [n for n in names if n.startswith("stop-reason-")]
    assert [attack.name for attack in select([])] == names
    with pytest.raises(ValueError, match="there is no attack 'nonsense'; there are: agent-killed, "):
        select(["nonsense"])


def test_all_attacks_fit_into_some_minutes():
    assert estimate(attacks(), 1) < 300
