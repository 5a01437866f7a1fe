"""The few kinds of failure, each with the exit code that the command line gives it (SPEC section 6)."""


class CalibkitError(Exception):
    """A failure that a person can act on: its message is one line that names what is wrong and the remedy."""

    exit_code = 4


class BadInputError(CalibkitError):
    """A file, topic, key or option is wrong; nothing was written."""

    exit_code = 2


class NotObservableError(CalibkitError):
    """This recording does not tell anything of what was asked for; nothing was written."""

    exit_code = 3


class NotConvergedError(CalibkitError):
    """The estimator found no answer; nothing was written."""

    exit_code = 4


def one_line(text: object, limit: int = 300) -> str:
    """Return text from an untrusted file as one printable line: no control or bidirectional characters, at most `limit` long."""
    flat = " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
    return flat if len(flat) <= limit else flat[: limit - 1] + "…"
