"""A service as a process: grant in, bridge up, loop, and an end that says goodbye."""

from __future__ import annotations

import gc
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from pydantic import ValidationError

from skytether.api.grant import DEFAULT_GRANT_PATH, GRANT_VARIABLE, Grant
from skytether.api.manifest import ServiceGraph
from skytether.api.service_report import FILE_NAME
from skytether.messages import warm
from skytether.wire.topic import Role

if TYPE_CHECKING:
    from skytether.bridge import Bridge

from . import any_topics
from .beat import beating
from .clock import SystemClock
from .errors import ConfigError, ServiceError
from .health_port import answering
from .loop import Loop
from .params import read_params
from .port import ServicePort, classes_of
from .service import Context, Service
from .step_times import StepTimes


def run(cls: type[Service[Any]]) -> NoReturn:
    """Be the process of a service: what its ``__main__`` calls. Exit status 0, 1 (failed) or 2 (badly configured)."""
    gc.disable()  # until all is loaded: none of that is garbage, and looking through it takes a tenth of the start
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    sys.exit(serve(cls, os.environ))


def serve(cls: type[Service[Any]], environ: Mapping[str, str]) -> int:
    """Run one service until SIGTERM, SIGINT or idle; returns the exit status. Needs the main thread."""
    try:
        grant = read_grant(environ)
        check_graph(grant, None)
        return _serve(cls, grant)
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return error.status


def read_grant(environ: Mapping[str, str]) -> Grant:
    """Read the file that ``SKYTETHER_GRANT`` names.

    Raises:
        ConfigError: It is not there, or no grant. The text never holds a value of it: one is the session's key.
    """
    path = environ.get(GRANT_VARIABLE, DEFAULT_GRANT_PATH)
    try:
        return Grant.model_validate_json(Path(path).read_bytes())
    except OSError as error:
        raise ConfigError(
            f"cannot read the grant {path}: {error.strerror}; the orchestrator makes it, {GRANT_VARIABLE} names it"
        ) from None
    except ValidationError as error:
        problems = error.errors(include_url=False, include_input=False, include_context=False)
        text = "; ".join(f"{'.'.join(map(str, p['loc'])) or 'document'}: {p['msg']}" for p in problems)
        raise ConfigError(f"the grant {path} is wrong: {text}") from None


def check_graph(grant: Grant, kind: ServiceGraph | None) -> None:
    """See that the manifest asks for what runs here: a graph of this kind, or none.

    Raises:
        ConfigError: It asks for another.
    """
    asked = grant.graph if grant.launch is not None else None
    if asked != kind and asked is not None:
        here = f"a graph of {kind}" if kind is not None else "a service without a graph"
        raise ConfigError(
            f"the manifest of {grant.service} says graph: {asked}, but its image or entry point starts {here}: "
            f"build the image on skytether/{asked}-base, and name no entrypoint"
        )


def check_topics(cls: type[Service[Any]], grant: Grant) -> None:
    """See that class and manifest speak of the same topics.

    Raises:
        ConfigError: Names the first topic that only one of them has, or has differently.
    """
    granted = {topic.name: _said(topic.kind, topic.direction, topic.type) for topic in grant.topics}
    declared = {d.topic: _said(d.kind, d.direction.value, d.type_name) for d in cls.declared}
    for name in [*declared, *granted]:
        if name not in granted:
            raise ConfigError(
                f"topic '{name}' of {cls.__name__} is not in the manifest of {grant.service}; add it there"
            )
        if name not in declared:
            raise ConfigError(f"topic '{name}' in the manifest of {grant.service} is not declared by {cls.__name__}")
        if granted[name] != declared[name]:
            raise ConfigError(
                f"topic '{name}' is {' '.join(granted[name])} in the manifest of {grant.service}, "
                f"but {' '.join(declared[name])} in {cls.__name__}"
            )


def _serve(cls: type[Service[Any]], grant: Grant) -> int:
    """Run with what was granted."""
    # Only a process needs the bridge: schemas and tests of services do without it.
    from skytether.bridge import Bridge, BridgeError, SessionSpec

    check_topics(cls, grant)
    params = read_params(cls.params_type, grant.params)
    try:
        spec = SessionSpec.from_api(Role.SERVICE, grant.session_id, grant.session_key, grant.topics)
        spec = replace(spec, topics=(*spec.topics, *any_topics.rows(topic.name for topic in grant.topics)))
    except ValueError as error:
        raise ConfigError(f"the grant is wrong: {error}") from None
    service = cls(params, Context(grant.robot, grant.instance, Path(grant.data_dir), time.time() - time.monotonic()))
    if grant.ready_file is not None:
        service.reports.path = Path(grant.ready_file).with_name(FILE_NAME)
    with closing(SystemClock()) as clock:
        port = ServicePort(service, clock.wake)
        times = StepTimes() if grant.step_times else None
        loop = Loop(service, port, clock, grant.idle_exit_s, times)
        bridge = Bridge(spec, port, bind=(grant.bind_host, grant.bind_port))
        with _ending_on_signals(loop), answering(grant):
            try:
                bridge.start()
                return _work(service, loop, bridge, grant, _teller(service, clock, times))
            except BridgeError as error:
                raise ServiceError(str(error)) from None
            finally:
                port.close()
                bridge.stop()


def _teller(service: Service[Any], clock: SystemClock, times: StepTimes | None) -> Callable[[], None]:
    """What tells how long steps take, where that is wanted."""

    def report() -> None:
        news = None if times is None else times.news(clock.now())
        if news is not None:
            service.reports.report_step_time(news)

    return report


def _work(service: Service[Any], loop: Loop, bridge: Bridge, grant: Grant, on_beat: Callable[[], None]) -> int:
    """From start to stop, the bridge being up."""
    started = False
    gc.freeze()
    gc.enable()
    try:
        service.start()
        started = True
        warm_up(service, grant)
        gc.freeze()  # what is there now stays: looking through it would cost a step or two (20 ms) now and then
        write_ready_file(grant, bridge.address[1])
        with beating(grant.ready_file, loop.in_step_for, on_beat=on_beat):
            loop.run()
    except ServiceError:
        raise
    except Exception:
        service.log.exception("the service failed")
        return 1
    finally:
        if started:
            service.stop()
    return 0


def _said(kind: str, direction: str, type_name: str) -> tuple[str, ...]:
    """A declaration in words."""
    return (direction, type_name) if kind == "topic" else (kind, direction, type_name)


def warm_up(service: Service[Any], grant: Grant) -> None:
    """Compile what the granted encodings need; another one that the robot chooses is compiled when it connects."""
    encodings = {topic.name: topic.encoding for topic in grant.topics}
    for declared in service.declared:
        if declared.kind.endswith("action"):
            continue  # no robot speaks all of them: what one speaks is compiled when it connects
        warm(classes_of(declared), encodings[declared.topic])


def write_ready_file(grant: Grant, port: int) -> None:
    """Tell the runtime where the bridge listens, in one piece."""
    if grant.ready_file is None:
        return
    path = Path(grant.ready_file)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(json.dumps({"port": port, "pid": os.getpid()}))
    draft.replace(path)


@contextmanager
def _ending_on_signals(loop: Loop) -> Iterator[None]:
    """SIGTERM and SIGINT end the loop after the current step."""
    before = {number: signal.signal(number, lambda *_: loop.stop()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
