"""``skytether lab``: experiments and benchmarks."""

from __future__ import annotations

import typer

from ...lazy import Lazy, LazyGroup


class _Bench(LazyGroup):
    table = {
        "safety": Lazy(
            "lab.safety",
            "safety",
            "Attack the robot's gate on real processes, and hold what the wheels received against what is promised.",
        ),
        "resize": Lazy(
            "lab.resize",
            "resize",
            "Give a driven robot's instance more cores and memory, and less, under load: the longest time"
            " without a command.",
        ),
        "ros": Lazy(
            "lab.ros",
            "ros",
            "A talker and a listener of ROS 2 as they are, and with Skytether between: delays, processor time.",
        ),
        "hostile": Lazy(
            "lab.hostile",
            "hostile",
            "Let one robot of a fleet attack the orchestrator with all it can, all at once, and look after the others.",
        ),
        "scale": Lazy(
            "lab.scale",
            "scale",
            "Thousands of instances at a Kubernetes site whose API server is made up: what they cost, how long"
            " robots wait.",
        ),
        "authentication": Lazy(
            "lab.authentication",
            "authentication",
            "Processor time of a message at both ends of the bridge, without sockets, and how much of it the"
            " tags take.",
        ),
        "mapping": Lazy(
            "lab.navigation",
            "mapping",
            "Build a map of a recorded log with the service navigation, and judge it by official relations.",
        ),
        "localisation": Lazy(
            "lab.navigation",
            "localisation",
            "Map the first 60 % of a corrected log, and find the robot in the rest, with noise on its odometry.",
        ),
        "navigation": Lazy(
            "lab.navigation",
            "navigation",
            "Drive the service navigation through the simulated building, and time each step of its loop of 30 Hz.",
        ),
        "face": Lazy(
            "lab.face", "face", "Look at a head that turns from side to side, with the service follow-in-front's eyes."
        ),
        "legs": Lazy(
            "lab.legs", "legs", "Track people by their legs in a recording, with the service follow-in-front's eyes."
        ),
        "start": Lazy(
            "lab.start", "start", "Time from a robot's request over REST to the first velocity command that it accepts."
        ),
        "join": Lazy(
            "lab.join",
            "join",
            "Time from a machine that has nothing but a Docker engine to a robot that is driven from there, by step.",
        ),
        "migrate": Lazy(
            "lab.migrate",
            "migrate",
            "Move a service from one site to another under a driven robot: the longest time without a command.",
        ),
        "api": Lazy(
            "lab.api",
            "api",
            "Ask an orchestrator that runs many instances: its answers, its reconcile passes, its memory.",
        ),
        "fleet": Lazy(
            "lab.fleet",
            "fleet",
            "Disturb a fleet in every way, and compare what it counted with what its orchestrator exports.",
        ),
        "failover": Lazy(
            "lab.failover",
            "failover",
            "Cut the link under a driven robot, and time it until its own controller drives.",
        ),
        "alarms": Lazy(
            "lab.failover",
            "alarms",
            "Drive a robot over a link that is never cut, beside busy programs, and count its needless stops.",
        ),
        "bridge": Lazy(
            "lab.bridge", "bridge", "The bridge and other transports: the same traffic on the same bad links."
        ),
    }


class _Run(LazyGroup):
    table = {
        "building": Lazy(
            "lab.building",
            "building",
            "A robot in the simulated building is driven by the service navigation, with parameters of your own,"
            " in real time.",
        ),
        "navigation": Lazy(
            "lab.run_navigation",
            "navigation",
            "Drive a simulated robot to nine goals with the service navigation, a person in its way (thesis,"
            " section 5.6).",
        ),
        "follow-in-front": Lazy(
            "lab.run_follow",
            "follow_in_front",
            "A simulated person steers a robot ahead of them by the face, one round of a lemniscate (thesis,"
            " section 5.5).",
        ),
    }


class _Scenario(LazyGroup):
    table = {
        "handover": Lazy(
            "lab.handover",
            "handover",
            "Change from one network to another in mid-stream: 128 bytes every 10 ms, both ways (thesis, section 3.5).",
        ),
    }


class _Lab(LazyGroup):
    table = {
        "world": Lazy(
            "lab.world",
            "world",
            "A robot in a simulated building: nine goals on a way of 41 m, and a person who steps in (thesis,"
            " section 5.6.2).",
        ),
    }


app = typer.Typer(cls=_Lab, help="Experiments and benchmarks on this machine.", no_args_is_help=True)
bench = typer.Typer(cls=_Bench, help="Measure the real program, and print what was measured.", no_args_is_help=True)
app.add_typer(bench, name="bench")
run = typer.Typer(
    cls=_Run, help="Experiments of the thesis that drive a service as a robot does.", no_args_is_help=True
)
app.add_typer(run, name="run")
scenario = typer.Typer(
    cls=_Scenario, help="Experiments of the thesis, done with the real program.", no_args_is_help=True
)
app.add_typer(scenario, name="scenario")
