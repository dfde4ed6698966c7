"""A world for two robots: two halls with two doors between them, and a crate in one that no map shows."""

from skytether.lab.trail import Pose
from skytether.lab.world.plan import Box, Plan

DOOR = 7.0
HALLS = Plan(
    "two halls",
    (
        Box("south", 5.5, 0.0, 11.0, 0.1, wall=True, height=2.0),
        Box("north", 5.5, 5.0, 11.0, 0.1, wall=True, height=2.0),
        Box("west", 0.0, 2.5, 0.1, 5.0, wall=True, height=2.0),
        Box("east", 11.0, 2.5, 0.1, 5.0, wall=True, height=2.0),
        # Between the halls, with a door at y = 0.6 to 1.8 m and one at 3.5 to 4.7 m.
        Box("between-1", DOOR, 0.3, 0.1, 0.6, wall=True, height=2.0),
        Box("between-2", DOOR, 2.65, 0.1, 1.7, wall=True, height=2.0),
        Box("between-3", DOOR, 4.85, 0.1, 0.3, wall=True, height=2.0),
        Box("shelf", 2.0, 4.7, 1.2, 0.4),
        Box("cupboard", 10.3, 3.2, 0.8, 0.5),
        Box("crate", DOOR, 1.2, 0.6, 0.9, mapped=False),
    ),
    (),
    (Pose(1.0, 1.2, 0.0), Pose(4.9, 2.6, -0.6)),
    (Pose(9.0, 1.2, 0.0),),
)
"""Behind the first robot's nearer door stands a crate that no map shows. The second robot sees it, the first does not
before it has come within 3 m."""
NEEDY, SCOUT = 0, 1
