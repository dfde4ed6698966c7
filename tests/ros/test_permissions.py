import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.api.manifest import TopicSpec
from skytether.ros.names import GraphNameError, Names
from skytether.ros.permissions import Access, Allowed, Permissions, canonical, check, refused

KEPT = {"/scan": "safety reads it", "/walker/joy": "safety reads it", "/cmd_vel_safe": "the wheels listen to it"}

LONG_S, WIDE_SLASH = "/\u017fcan", "\uff0fscan"


def permissions(home="/walker", service="/trail", *, publish=(), call=(), offer=(), protected=KEPT):
    return Permissions(home, service, Allowed(publish, call, offer), protected)


def row(name, direction="out", kind="topic", typ="std_msgs/msg/String"):
    return TopicSpec(name=name, type=typ, direction=direction, kind=kind)


def test_a_service_has_its_own_namespace_and_nothing_else():
    may = permissions()
    assert may.refusal(Access.PUBLISH, "/trail/path") == ""
    assert may.refusal(Access.OFFER, "/trail/plan") == ""
    for access, name in [
        (Access.PUBLISH, "/tf"),
        (Access.PUBLISH, "/walker/map"),
        (Access.PUBLISH, "/trails/path"),
        (Access.CALL, "/walker/get_map"),
        (Access.CALL, "/trail/plan"),
        (Access.OFFER, "/walker/say"),
    ]:
        sentence = may.refusal(access, name)
        assert name in sentence
        assert f"cloud: {{{access}: [{name}]}}" in sentence


def test_what_is_listed_is_allowed_with_all_below_it_and_for_that_alone():
    may = permissions(publish=["/tf", "/walker/move_base"], call=["/walker/get_map"])
    assert may.refusal(Access.PUBLISH, "/tf") == ""
    assert may.refusal(Access.PUBLISH, "/walker/move_base/goal") == ""
    assert may.refusal(Access.CALL, "/walker/get_map") == ""
    assert may.refusal(Access.OFFER, "/walker/get_map")
    assert may.refusal(Access.PUBLISH, "/walker/move_base_simple/goal")
    assert may.refusal(Access.PUBLISH, "/TF"), "names that are given away are taken by the letter"


def test_a_list_of_everything_leaves_out_what_is_protected():
    may = permissions(publish=["/"], call=["/"], offer=["/"])
    assert may.refusal(Access.PUBLISH, "/anything/at/all") == ""
    for name in [*KEPT, "/clock"]:
        for access in Access:
            assert "never" in may.refusal(access, name)


def test_services_that_change_a_node_are_listed_in_full():
    may = permissions(call=["/", "/camera/set_parameters"])
    assert may.refusal(Access.CALL, "/camera/set_parameters") == ""
    for name in ("/laser/set_parameters", "/laser/set_parameters_atomically", "/laser/change_state"):
        assert f"call: [{name}]" in may.refusal(Access.CALL, name)


def test_a_service_that_is_called_like_the_robot_is_not_given_the_robot_s_topics():
    assert permissions("/walker", "/walker").refusal(Access.PUBLISH, "/walker/map")
    assert permissions("/walker/base", "/walker").refusal(Access.PUBLISH, "/walker/base/map")
    assert permissions("/walker/base", "/walker").refusal(Access.PUBLISH, "/walker/path") == ""
    assert permissions("/", "/trail").refusal(Access.PUBLISH, "/trail/path") == ""


@pytest.mark.parametrize(
    "name",
    [
        "//scan",
        "/scan/",
        "/Scan",
        "~scan",
        "scan",
        "/~/scan",
        LONG_S,
        WIDE_SLASH,
        "/rt/scan",
        "/rt/rt/scan",
        " /scan\n",
    ],
)
def test_a_protected_name_is_protected_in_every_spelling(name):
    assert permissions(publish=["/", name]).protected(name)


WAYS = st.sampled_from(["out", "in"])
SPELLINGS = st.text(st.sampled_from("/~ \tsScCaAnNjJoOyYrRtT\u017f\uff0f_0walkerWALKER"), max_size=24)


@given(name=SPELLINGS, home=st.sampled_from(["/", "/walker", "/a/b"]), remap=SPELLINGS, direction=WAYS)
def test_no_spelling_remapping_or_namespace_leads_to_what_is_protected(name, home, remap, direction):
    """Whatever a manifest and a remapping make of a name: the graph's own spelling is never a protected one."""
    assert_kept(name, home, {name: remap} if remap else {}, direction)


@given(
    kept=st.sampled_from(sorted(KEPT)),
    slashes=st.lists(st.sampled_from(["", "/", "//", "~", "~/", "/rt/", " "]), max_size=2),
    tail=st.sampled_from(["", "/", "//", " "]),
    upper=st.booleans(),
    home=st.sampled_from(["/", "/walker", "/rt"]),
)
def test_no_way_of_writing_a_protected_name_is_let_through(kept, slashes, tail, upper, home):
    name = "".join(slashes) + (kept.upper() if upper else kept) + tail
    assert_kept(name, home, {}, "out")
    assert_kept(name.replace(kept, kept.removeprefix("/")), home, {}, "out")
    assert_kept("harmless", home, {"harmless": name}, "out")


def assert_kept(name, home, remap, direction):
    may = permissions(home, "/trail", publish=["/"], call=["/"], offer=["/"])
    rows = [row(name, direction)] if name and name != "*" else []
    if name and name != "*":
        rows += [row(name, direction, "call", "std_srvs/srv/Trigger")]
    for spec in rows:
        for ros in (1, 2):
            try:
                names = Names([spec], home, "/trail", remap, ros=ros)
            except GraphNameError:
                continue  # no name of a graph at all
            used = names.of(spec.name)
            if direction == "out" or spec.kind == "call":
                assert bool(refused(may, [spec], names, "cmd_vel")) == (canonical(used) in {*KEPT, "/clock"})
            if used in KEPT:
                assert may.protected(used)


def test_every_part_of_an_action_and_both_ways_of_a_call_are_looked_at():
    specs = [
        row("/move_base", "out", "action", "move_base_msgs/action/MoveBase"),
        row("/navigate", "out", "ros2_action", "nav2_msgs/action/NavigateToPose"),
        row("dock", "in", "ros2_action", "my_msgs/action/Dock"),
        row("/get_map", "out", "call", "nav_msgs/srv/GetMap"),
        row("/reset", "in", "call", "std_srvs/srv/Trigger"),
        row("cmd_vel"),
        row("/cmd_vel_safe"),
    ]
    names = Names(specs, "/walker", "/trail")
    found = {name: sentence for _, name, sentence in refused(permissions(), specs, names, "cmd_vel")}
    assert set(found) == {
        *("/move_base/goal", "/move_base/cancel"),
        *(f"/navigate/_action/{part}" for part in ("send_goal", "cancel_goal", "get_result")),
        *("/get_map", "/reset", "/cmd_vel_safe"),
    }
    with pytest.raises(
        ValueError, match=r"'/cmd_vel_safe': /cmd_vel_safe is never published for the cloud: the wheels"
    ):
        check(permissions(), specs, names, "cmd_vel")
    parts = "/navigate/_action/send_goal, /navigate/_action/cancel_goal, /navigate/_action/get_result"
    lists = f"publish: [/move_base/goal, /move_base/cancel], call: [{parts}, /get_map], offer: [/reset]"
    with pytest.raises(ValueError, match=re.escape(f"cloud: {{{lists}}}")):
        check(permissions(), specs, names, "cmd_vel")
    listed = permissions(publish=["/move_base"], call=["/navigate", "/get_map"], offer=["/reset"])
    check(listed, specs[:-1], names, "cmd_vel")
