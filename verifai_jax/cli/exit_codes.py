"""Exit codes of the command line, the same for every command, and which error has which.

| code | meaning |
|---|---|
| 0 | it did its work; `falsify` that finds failures has done its work |
| 1 | a gate that was asked for by `--fail-on` failed |
| 2 | wrong usage: an option, a name, a file or a package that is not as it should be |
| 3 | the tool or the simulator broke, or no simulation had a verdict |
| 4 | a row that was simulated again did not give its number, and --even-if-changed was not given |
| 129, 143 | ended by SIGHUP or SIGTERM, after what was finished is saved |
| 130 | interrupted before there was a result |
| 141 | whoever read the output has closed the pipe, as `head` does |
"""

import sys
import traceback

import click

from verifai_jax.core.messages.errors import MissingExtra

GATE_FAILED = 1
WRONG_USAGE = 2
BROKEN = 3
NOT_AGAIN = 4
INTERRUPTED = 130
CLOSED_PIPE = 141
EPILOG = """\b
Exit codes:
  0  it did its work; falsify that finds failures has done its work
  1  a gate asked for with --fail-on failed
  2  wrong usage
  3  the tool or the simulator broke, or no simulation had a verdict
  4  a row that was simulated again did not give its number
"""
"""What `--help` says of them."""
_MAX_ERROR_LENGTH = 4000
"""Characters of an error that are printed: it may quote a file, or the message of a system."""
USAGE_ERRORS = (
    ValueError, TypeError, IndexError, MissingExtra, FileNotFoundError, FileExistsError,
    NotADirectoryError, IsADirectoryError, PermissionError,
)  # fmt: skip
"""Errors by which the Python API refuses what it was given."""


class CommandError(click.ClickException):
    """An error reported in one line, with its exit code."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code  # pyright: ignore[reportAttributeAccessIssue]


def fail_gate() -> click.exceptions.Exit:
    """Return the error that ends a command whose gate failed."""
    return click.exceptions.Exit(GATE_FAILED)


def check_again(finding: str, even_if_changed: bool) -> None:
    """End the command with code 4 if a row did not reproduce its number, as a finding says."""
    if finding and not even_if_changed:
        raise click.exceptions.Exit(NOT_AGAIN)


def command_error(error: BaseException, show_traceback: bool = False) -> CommandError:
    """Turn an error of the Python API into a one-line error of the command line.

    A traceback is printed if requested, and if the error is a bug of this package: not a refusal,
    not a failure that the package foresees, and not raised by the user's own code.
    """
    from verifai_jax.core.messages.text import printable

    message, code = _message_and_code(error)
    if show_traceback or not message:
        sys.stderr.write(printable("".join(traceback.format_exception(error))))
    if not message:
        message = (
            f"{type(error).__name__}: {error}\nThis is a bug of verifai_jax; please report it "
            "with the lines above"
        )
    return CommandError(printable(message, _MAX_ERROR_LENGTH), code)


def _message_and_code(error: BaseException) -> tuple[str, int]:
    """Return the message and the exit code of an error; no message for a bug."""
    if isinstance(error, USAGE_ERRORS):
        return str(error), WRONG_USAGE
    foreseen = isinstance(error, RuntimeError) and type(error).__module__.startswith("verifai_jax.")
    if isinstance(error, OSError) and error.strerror and error.filename is None:
        # Files are named where they are written; what has no name is the standard output.
        advice = "send it to a file on another disk"
        return f"the output cannot be written ({error.strerror}); {advice}", BROKEN
    if foreseen or isinstance(error, OSError):
        return str(error), BROKEN
    if isinstance(error, MemoryError):
        return "the machine has not enough memory; a smaller --batch needs less", BROKEN
    from verifai_jax.core.user_code import user_errors

    if (raised := user_errors.raised_in_callback(error)) is not None:
        return raised, BROKEN
    of_user = user_errors.user_line(error) is not None
    return user_errors.explain_user_error(error) if of_user else "", BROKEN
