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
from verifai_jax.cli.explain import explain
from verifai_jax.cli.falsify import falsify
from verifai_jax.cli.list import list_targets
from verifai_jax.cli.monitor import monitor
from verifai_jax.cli.repair import repair
from verifai_jax.cli.replay import replay
from verifai_jax.cli.shrink import shrink
from verifai_jax.cli.sweep import sweep
from verifai_jax.cli.synthesize import synthesize
from verifai_jax.core.errors import MissingExtra, unknown_name

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
    """Command group that reports a user's mistake in one line, without a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (click.exceptions.Exit, click.Abort):
            # Both are RuntimeErrors to Python, and neither is a mistake.
            raise
        except (ValueError, TypeError, IndexError, OSError, MissingExtra) as error:
            if ctx.params.get("traceback"):
                raise
            raise click.ClickException(str(error)) from error
        except RuntimeError as error:
            from verifai_jax.falsification import RunError

            if ctx.params.get("traceback") or not isinstance(error, RunError):
                raise
            raise click.ClickException(str(error)) from error

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            raise click.UsageError(str(unknown_name("command", args[0], self.list_commands(ctx))))
        return super().resolve_command(ctx, args)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="verifai-jax")
@click.option("--traceback", is_flag=True, help="Show where an error was raised.")
def main(traceback: bool) -> None:
    """Find inputs that make a closed-loop system break a temporal-logic property."""


for _command in COMMANDS:
    main.add_command(_command)
