"""Following in front: a robot that stays ahead of the person who walks behind it (thesis 5.5).

`service` is the shell; `follower` the loop without topics. The rest is pure, and without clocks. Legs: `clusters` cuts
a scan into pieces, `legs` tells which look like legs, `background` what has stood there all the time, `assignment`
gives legs to people, `person` is one of them, and `tracker` all. Faces: `picture_parts` and `camera_image` make pixels
of a file, `face_detector`, `face_landmarks` and `head_pose` find faces and where they point, `face_tracker` does so
from picture to picture. `operator` picks the one to follow, `face_choice` their face, and `formation` is the control
law. `bench_legs` and `bench_face` run the eyes on recordings; `head_mesh` made the simulated operator's head.
"""
