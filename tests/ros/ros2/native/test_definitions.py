"""Definitions that ROS 2's Python tells of types, by the hashes of what rosbags understands of them."""

import json
import re
import subprocess
from pathlib import Path

import pytest
from ros2_nodes import ros2_nodes
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from skytether.ros.ros2.native import side

__all__ = ["ros2_nodes"]
pytestmark = pytest.mark.ros2

SIDE = Path(side.__file__).parent
TYPES = ["Arrays", "BasicTypes", "BoundedSequences", "Builtins", "Defaults", "MultiNested", "Nested", "Strings"]
ASK = f"""
import json, pathlib, sys
import test_msgs
sys.path.insert(0, {str(SIDE.parent)!r})
from side import definitions
prefix = next(p for p in pathlib.Path(test_msgs.__file__).parents if (p / "share" / "test_msgs").is_dir())
def known(name):
    told = json.loads((prefix / "share" / (name + ".json")).read_text())
    return {{row["type_name"]: row["hash_string"] for row in told["type_hashes"]}}[name]
installed = {{name: definitions.definition(name) for name in sys.argv[1:]}}
definitions._installed = lambda name: ""
built = {{name: definitions.definition(name) for name in sys.argv[1:]}}
hashes = {{name: known(name) for name in sys.argv[1:]}}
parts = definitions.definition("test_msgs/action/Fibonacci_FeedbackMessage")
print(json.dumps([installed, built, hashes, parts]))
"""


def rihs(name, text):
    store = get_typestore(Stores.EMPTY)
    # A char is an uint8 to ROS 2, also in hashes; rosbags has a hash of its own for it.
    store.register(get_types_from_msg(re.sub(r"^char\b", "uint8", text, flags=re.MULTILINE), name))
    return store.hash_rihs01(name)


def test_definitions_are_those_of_the_hashes_from_files_and_from_classes(ros2_nodes):
    names = [f"test_msgs/msg/{name}" for name in [*TYPES, "KeyedLong"]]  # the last has an IDL alone
    done = subprocess.run([ros2_nodes.python, "-c", ASK, *names], capture_output=True, text=True, check=True)
    installed, built, hashes, parts = json.loads(done.stdout)
    assert {name: rihs(name, text) for name, text in installed.items()} == hashes
    assert {name: rihs(name, text) for name, text in built.items()} == hashes
    assert "MSG: test_msgs/Fibonacci_Feedback\nint32[] sequence\n" in parts
    assert "string STRING_CONST=Hello world!\n" in built["test_msgs/msg/Strings"]
