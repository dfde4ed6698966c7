"""What goes wrong with a trial."""


class TrialError(Exception):
    """A trial could not begin, or leaves something behind; the text says why, in one sentence."""
