import pytest

from skytether.robot.graphs.wheels_watch import LEFT_BEHIND, MOST, UNNAMED, Doubles, Others, WheelsWatch, strangers

OURS = ("/skytether_guard", "/skytether_gate")


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([], ()),
        ([*OURS], ()),
        (["/skytether_guard"], ()),
        ([*OURS, "/teleop"], ("/teleop",)),
        (["/teleop", "/teleop"], ("/teleop",)),
        ([*OURS, ""], ()),
    ],
)
def test_who_is_none_of_ours(found, expected):
    assert strangers(found, OURS) == expected


@pytest.mark.parametrize("found", [["", "", ""], [*OURS, ""], [OURS[0], "", ""]])
def test_one_more_without_a_name_is_told_once_it_stays(found):
    doubles = Doubles(OURS)
    assert {doubles.poll(found) for _ in range(LEFT_BEHIND)} == {()}
    assert doubles.poll(found) == (UNNAMED,)
    assert doubles.poll(["", ""]) == ()


@pytest.mark.parametrize("shown", [OURS[0], ""])
def test_several_of_ours_that_were_killed_one_after_the_other_are_no_others(shown):
    """DDS shows each for 20 s; one is there all the time, and the next one after that."""
    doubles = Doubles(OURS)
    for look in range(200):
        left = sum(at <= look < at + 20 for at in range(10, 150, 12))
        assert doubles.poll([*OURS, *[shown] * left]) == ()


def test_a_crowd_is_cut_off():
    assert len(strangers([f"/n{i}" for i in range(1000)], OURS)) == MOST


def test_each_is_named_once_while_it_lasts_and_counted(caplog):
    found = [*OURS]
    watch = WheelsWatch("/cmd_vel", OURS, lambda: found, look_s=3600)
    watch.poll()
    assert watch.others == Others((), 0)
    found.append("/teleop")
    watch.poll()
    watch.poll()
    assert watch.others == Others(("/teleop",), 1)
    found.remove("/teleop")
    watch.poll()
    found.append("/teleop")
    watch.poll()
    assert watch.others == Others(("/teleop",), 2)
    assert sum("/teleop publishes /cmd_vel too" in message for message in caplog.messages) == 2
    watch.close()


def test_a_graph_that_does_not_answer_tells_nothing_new():
    answers = iter([["/teleop"], OSError("no master")])

    def find():
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    watch = WheelsWatch("/cmd_vel", OURS, find, look_s=3600)
    watch.poll()
    watch.poll()
    assert watch.others == Others(("/teleop",), 1)
    watch.close()


def test_another_gate_of_our_configuration_is_named_and_a_killed_writer_is_not():
    """Two gates with folders of their own drove the same wheels, and neither status said so."""
    found = [*OURS, OURS[0]]
    watch = WheelsWatch("/cmd_vel", OURS, lambda: found, look_s=3600)
    for _ in range(LEFT_BEHIND):
        watch.poll()
    found.remove(OURS[0])
    watch.poll()
    assert watch.others == Others((), 0)
    found.append(OURS[0])
    for _ in range(LEFT_BEHIND + 1):
        watch.poll()
    assert watch.others == Others(("another /skytether_guard",), 1)
    watch.close()
