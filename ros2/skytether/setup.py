"""The package as ament has it: a marker, package.xml and launch files in share, programs in lib/skytether."""

from glob import glob

from setuptools import setup

setup(
    # Not `skytether`, neither distribution nor module: ROS puts both on PYTHONPATH, before what the agent's own Python
    # has, and there they would take the place of the platform and of its entry points.
    name="skytether_ros",
    version="0.1.0",
    description="Cloud services for a robot of ROS 2",
    license="Apache-2.0",
    maintainer="The Skytether developers",
    maintainer_email="skytether@example.org",
    packages=["skytether_ros"],
    install_requires=["setuptools"],
    zip_safe=False,
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/skytether"]),
        ("share/skytether", ["package.xml"]),
        ("share/skytether/launch", sorted(glob("launch/robot.launch.*"))),
    ],
    entry_points={
        "console_scripts": [
            "robot_run = skytether_ros.nodes:robot_run",
            "robot_gate = skytether_ros.nodes:robot_gate",
        ]
    },
)
