"""Who could have been handed a folder of a volume: whoever had something in common with it, by however many others."""

from __future__ import annotations

from skytether.node.kin import Kin


def test_containers_are_kin_by_a_volume_and_by_a_network_and_by_others() -> None:
    kin = Kin()
    kin.meet(("a", "volume 1", "volume of a"))
    kin.meet(("b", "volume 1", "volume 2"))
    kin.meet(("c", "volume 2"))
    kin.meet(("guard", "c"))  # in the network of c
    kin.meet(("other", "volume of another"))
    family = {"a", "b", "c", "guard", "volume 1", "volume 2", "volume of a"}
    for one in family:
        assert kin.of((one,)) == family
    assert kin.of(("volume of another",)) == {"other", "volume of another"}
    assert kin.of(("other", "a")) == family | {"other", "volume of another"}
    assert kin.all() == kin.of(("other", "a"))


def test_what_nobody_has_met_is_kin_of_itself_alone() -> None:
    kin = Kin()
    kin.meet(("a", "volume 1"))
    assert kin.of(("new",)) == {"new"}
    kin.meet(())
    kin.meet(("alone",))
    assert kin.of(("alone",)) == {"alone"}


def test_two_families_become_one_by_whoever_meets_both() -> None:
    kin = Kin()
    for number in range(100):
        kin.meet((f"a{number}", "volume a"))
        kin.meet((f"b{number}", "volume b"))
    assert "b7" not in kin.of(("a7",))
    kin.meet(("both", "volume a", "volume b"))
    assert len(kin.of(("a7",))) == 203
    assert kin.of(("volume b",)) == kin.of(("a99",)) == kin.all()


def test_who_has_ended_is_kin_still_as_long_as_one_of_them_runs() -> None:
    """The folder that he gave is held by whom he gave it to, who may have given it on."""
    kin = Kin()
    kin.meet(("giver", "volume 1"))
    kin.meet(("between", "volume 1", "volume 2"))
    kin.meet(("last", "volume 2"))
    kin.meet(("other", "volume 3"))
    kin.keep(("last",))
    assert "last" in kin.of(("volume 1",))
    assert kin.of(("volume 3",)) == {"volume 3"}
    kin.keep(())
    assert len(kin.all()) == 0


def test_of_whom_none_runs_all_are_forgotten() -> None:
    kin = Kin()
    kin.meet(("a", "volume 1"))
    kin.meet(("b", "volume 1"))
    kin.meet(("other", "volume 3"))
    kin.forget(("volume 1", "new"))
    assert kin.all() == {"other", "volume 3"}
    kin.meet(("c", "volume 1"))
    assert kin.of(("c",)) == {"c", "volume 1"}


def test_of_more_than_some_nobody_knows_who_met_whom_until_nobody_runs() -> None:
    kin = Kin(most=3)
    assert kin.has_room(("a", "volume 1", "volume 2"))
    kin.meet(("a", "volume 1"))
    assert kin.has_room(("a", "volume 1", "b"))
    assert not kin.has_room(("b", "volume 2"))
    kin.meet(("b", "volume 2"))
    assert kin.lost
    kin.meet(("c", "volume 2"))
    assert len(kin.all()) == 0
    kin.keep(("a",))
    assert kin.lost
    kin.keep(())
    assert not kin.lost
    kin.meet(("b", "volume 2"))
    assert kin.of(("b",)) == {"b", "volume 2"}
