"""`--fail-on GATE`: conditions under which a command ends with code 1.

    @fail_on(counterexample="if a counterexample was found", rate="unless ...")
    def falsify(..., fail_on: Gate | None): ...
        check_gate(fail_on, {"counterexample": run.table.counts.may_fail})

A gate is a name, or `rate>P` for a failure rate. It passes only if the result proves it: a rate
whose interval reaches above P fails the gate.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import click

from verifai_jax.cli.exit_codes import fail_gate
from verifai_jax.cli.json_output import give_result
from verifai_jax.core.messages.errors import nearest_names

Command = TypeVar("Command", bound=Callable[..., object])
RATE = "rate"
"""Name of the gate with a bound."""


class Gate(NamedTuple):
    """A gate requested by the user; its bound is the largest failure rate that passes."""

    name: str
    bound: float | None = None

    def __str__(self) -> str:
        return self.name if self.bound is None else f"{self.name}>{self.bound:zg}"


class GateType(click.ParamType):
    """The gates of one command, as click reads them."""

    name = "gate"

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Return the gates for `--help`."""
        return f"[{'|'.join(self._forms())}]"

    def convert(self, value: Any, param: Any, ctx: Any) -> Gate:
        """Read a gate; anything else is a usage error that lists the gates."""
        if isinstance(value, Gate):
            return value
        name, sign, bound = str(value).replace(" ", "").partition(">")
        if name == RATE and RATE in self.names:
            try:
                limit = float(bound)
            except ValueError:
                limit = -1.0
            if sign and 0 < limit < 1:
                return Gate(RATE, limit)
            self.fail(f"{value!r} must be rate>P with P between 0 and 1, such as rate>0.01")
        if name in self.names and not sign:
            return Gate(name)
        near = nearest_names(name, self._forms()) or "."
        self.fail(f"there is no gate {value!r} here{near} Known: {', '.join(self._forms())}.")

    def _forms(self) -> list[str]:
        return ["rate>P" if name == RATE else name for name in self.names]


def fail_on(**gates: str) -> Callable[[Command], Command]:
    """Return the option `--fail-on` of a command.

    **Arguments:**
    - `gates`: a description of when each gate fails, by name; `rate` has a bound, `rate>P`.
    """
    words = "; ".join(f"{'rate>P' if name == RATE else name}: {t}" for name, t in gates.items())
    return click.option("--fail-on", type=GateType(tuple(gates)), help=f"End with code 1. {words}.")


def check_gate(asked: Gate | None, failed: Mapping[str, bool]) -> None:
    """End the command with code 1 if the requested gate is among those that failed, by name."""
    if asked is None:
        return
    give_result(gate={"asked": str(asked), "passed": not failed[asked.name]})
    if failed[asked.name]:
        raise fail_gate()


def exceeds(asked: Gate | None, high: float | None) -> bool:
    """Return whether a rate whose interval ends at `high` may exceed the bound of the gate."""
    if asked is None or asked.bound is None:
        return False
    # Without a rate, as where nothing had a verdict, nothing is shown.
    return high is None or not high <= asked.bound
