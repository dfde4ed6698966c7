"""What the service says of itself: a code for programs, and a sentence for people."""

from __future__ import annotations

from enum import StrEnum


class Code(StrEnum):
    """Why the robot goes as it goes. These are the states of the manifest, too, each of which is a metric."""

    FOLLOWING = "following"
    FACE_SLOW = "face_slow"
    NO_OPERATOR = "no_operator"
    SEVERAL_PEOPLE = "several_people"
    OPERATOR_LOST = "operator_lost"
    OPERATOR_ASIDE = "operator_aside"
    NO_FACE = "no_face"
    SEVERAL_FACES = "several_faces"
    BAD_PICTURE = "bad_picture"
    CAMERA_SILENT = "camera_silent"
    LASER_SILENT = "laser_silent"
    ODOMETRY_SILENT = "odometry_silent"
    LASER_UNKNOWN = "laser_unknown"
    LATE = "late"


SENTENCES = {
    Code.FOLLOWING: "The robot goes ahead of its operator.",
    Code.FACE_SLOW: "Faces come too seldom: the robot goes slowly.",
    Code.NO_OPERATOR: "Nobody walks behind the robot.",
    Code.SEVERAL_PEOPLE: "More than one could be the operator: one of them has to step aside.",
    Code.OPERATOR_LOST: "The operator's legs are not in sight.",
    Code.OPERATOR_ASIDE: "The operator is too far aside of the robot.",
    Code.NO_FACE: "The operator's face is not in sight.",
    Code.SEVERAL_FACES: "More than one face is where the operator is.",
    Code.BAD_PICTURE: "The camera's pictures show nothing",
    Code.CAMERA_SILENT: "No pictures come from the camera.",
    Code.LASER_SILENT: "No scans come from the rear laser.",
    Code.ODOMETRY_SILENT: "No odometry comes from the robot.",
    Code.LASER_UNKNOWN: "No transform tells where the rear laser is: publish it on tf, or set the parameter laser.",
    Code.LATE: "What the robot measures arrives too late to go by, or nobody knows how late.",
}
