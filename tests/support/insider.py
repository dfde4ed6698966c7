"""What only an end of a session knows: for tests in which an authentic peer says what no `Session` would."""

from skytether.wire import Session
from skytether.wire.state.epoch import Epoch


def epoch_of(session: Session) -> Epoch:
    """The keys that an end uses, and where it is with them."""
    epoch = session._epochs.current  # noqa: SLF001 keys are what a session must show nobody
    assert epoch is not None
    return epoch


def next_number(session: Session, path: int) -> int | None:
    """A packet number of a path that nothing was sent with; None: this end has no such path."""
    known = session._paths.get(path)  # noqa: SLF001 whoever sends packets for a session needs its numbers
    return None if known is None else known.number()
