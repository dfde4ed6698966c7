"""What ends a service with one sentence instead of a traceback."""

from __future__ import annotations


class ServiceError(Exception):
    """The service cannot do its work; the text is one sentence that says what to do. Exit status 1."""

    status = 1


class ConfigError(ServiceError):
    """The grant or the parameters are wrong. Exit status 2: starting again would not help."""

    status = 2


class CallError(Exception):
    """A call has no answer; the text says why. A method that answers calls raises it to tell the robot why not."""
