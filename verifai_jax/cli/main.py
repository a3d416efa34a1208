"""The `verifai-jax` command: each sub-command is one call into the Python API.

verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000
verifai-jax replay runs/balance-1 417
verifai-jax monitor "always[0, 4] abs(x) <= 2.4" trace.csv
"""

import atexit
import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

import click

from verifai_jax._version import __version__
from verifai_jax.cli.confirm import confirm
from verifai_jax.cli.exit_codes import CLOSED_PIPE, EPILOG, INTERRUPTED, CommandError, command_error
from verifai_jax.cli.explain import explain
from verifai_jax.cli.falsify import falsify
from verifai_jax.cli.going_on import WORDS
from verifai_jax.cli.list import list_targets
from verifai_jax.cli.new import new
from verifai_jax.cli.replay import replay
from verifai_jax.cli.shrink import shrink
from verifai_jax.core.display.extensions import extension, extensions
from verifai_jax.core.messages.errors import unknown_name

COMMANDS = (falsify, list_targets, replay, confirm, explain, shrink, new)
"""The sub-commands of the core. Their files import nothing heavy until a command runs."""
GROUP = "verifai_jax.commands"
"""Entry points of the sub-commands of add-ons and of other packages."""


@contextlib.contextmanager
def _signals_interrupt() -> Iterator[list[int]]:
    """Let SIGTERM and SIGHUP interrupt as Ctrl-C does, so that a command saves its results."""
    received: list[int] = []

    def interrupt(number: int, _: object) -> None:
        # A second one of a kind ends the process at once.
        signal.signal(number, signal.SIG_DFL)
        received.append(number)
        raise KeyboardInterrupt

    # Those that are ignored (`nohup`) stay ignored.
    here = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)] if here else []
    taken = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in taken:
        signal.signal(number, interrupt)
    try:
        yield received
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def _closed_pipe() -> click.exceptions.Exit:
    """Return the exit of a command whose reader has closed the pipe, which is not an error."""
    # Python's own last flush must not fail either.
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return click.exceptions.Exit(CLOSED_PIPE)


class _Group(click.Group):
    """Command group that tells an error in one line, with the exit code of its kind."""

    def make_context(
        self, info_name: str | None, args: list[str], *rest: Any, **options: Any
    ) -> click.Context:
        words = list(args)
        try:
            context = super().make_context(info_name, args, *rest, **options)
            context.meta[WORDS] = words
            return context
        except BrokenPipeError:  # Of what --help and --version print.
            raise _closed_pipe() from None
        except OSError as error:
            raise command_error(error) from error

    def invoke(self, ctx: click.Context) -> Any:
        # A command imports and traces millions of objects that stay: looking at all of them as
        # often as Python does by itself takes a tenth of the time.
        gc.set_threshold(50_000, 20, 20)
        # And Python does at its end, for up to half a second.
        atexit.register(gc.freeze)
        with _signals_interrupt() as received:
            try:
                result = super().invoke(ctx)
            except BrokenPipeError:
                raise _closed_pipe() from None
            except CommandError as error:
                if received:
                    error.exit_code = 128 + received[0]  # pyright: ignore[reportAttributeAccessIssue]
                raise
            except (click.exceptions.Exit, click.Abort, click.ClickException):
                raise  # Click's own: nothing to translate.
            except KeyboardInterrupt:
                code = 128 + received[0] if received else INTERRUPTED
                raise CommandError("interrupted", code) from None
            except BaseException as error:
                raise command_error(error, bool(ctx.params.get("traceback"))) from error
        if received:
            raise click.exceptions.Exit(128 + received[0])
        return result

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *extensions(GROUP)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        found = super().get_command(ctx, cmd_name)
        if found is None and cmd_name in extensions(GROUP):
            found = extension(GROUP, cmd_name)
            found.epilog = EPILOG
            self.add_command(found)
        return found

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            raise click.UsageError(str(unknown_name("command", args[0], self.list_commands(ctx))))
        return super().resolve_command(ctx, args)


@click.group(cls=_Group, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="verifai-jax")
@click.option("--traceback", is_flag=True, help="Show a traceback for errors.")
def main(traceback: bool) -> None:
    """Find inputs that make a closed-loop system break a temporal-logic property."""


for _command in COMMANDS:
    _command.epilog = EPILOG
    main.add_command(_command)
if __name__ == "__main__":
    main(prog_name="verifai-jax")
