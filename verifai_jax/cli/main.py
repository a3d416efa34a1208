"""The `verifai-jax` command: each sub-command is one call into the Python API.

verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000
verifai-jax replay runs/balance-1 417
verifai-jax monitor "always[0, 4] abs(x) <= 2.4" trace.csv
"""

from typing import Any

import click

from verifai_jax._version import __version__
from verifai_jax.cli.analyze import analyze
from verifai_jax.cli.confirm import confirm
from verifai_jax.cli.doctor import doctor
from verifai_jax.cli.estimate import estimate
from verifai_jax.cli.exit_codes import EPILOG, INTERRUPTED, CommandError, command_error
from verifai_jax.cli.explain import explain
from verifai_jax.cli.falsify import falsify
from verifai_jax.cli.list import list_targets
from verifai_jax.cli.monitor import monitor
from verifai_jax.cli.repair import repair
from verifai_jax.cli.replay import replay
from verifai_jax.cli.shrink import shrink
from verifai_jax.cli.sweep import sweep
from verifai_jax.cli.synthesize import synthesize
from verifai_jax.core.errors import unknown_name

COMMANDS = (
    falsify,
    list_targets,
    replay,
    analyze,
    monitor,
    doctor,
    confirm,
    estimate,
    explain,
    repair,
    shrink,
    sweep,
    synthesize,
)
"""The sub-commands. Their files import nothing heavy until a command runs."""


class _Group(click.Group):
    """Command group that tells an error in one line, with the exit code of its kind."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (click.exceptions.Exit, click.Abort, click.ClickException, BrokenPipeError):
            # Click's own: nothing to translate. A reader that closed its pipe is no mistake.
            raise
        except KeyboardInterrupt:
            raise CommandError("interrupted", INTERRUPTED) from None
        except Exception as error:
            raise command_error(error, bool(ctx.params.get("traceback"))) from error

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            raise click.UsageError(str(unknown_name("command", args[0], self.list_commands(ctx))))
        return super().resolve_command(ctx, args)


@click.group(cls=_Group, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="verifai-jax")
@click.option("--traceback", is_flag=True, help="Show where an error was raised.")
def main(traceback: bool) -> None:
    """Find inputs that make a closed-loop system break a temporal-logic property."""


for _command in COMMANDS:
    _command.epilog = EPILOG
    main.add_command(_command)
