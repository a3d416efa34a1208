"""The time in which a run has no simulator that works for it."""

import logging

log = logging.getLogger("verifai_jax.remote")

REMINDER = 10.0
"""Seconds without a client until the log says so; then twice as long, up to 60."""


class Absence:
    """The time since the last client left, of which the log reminds."""

    def __init__(self) -> None:
        self.since: float | None = None
        self._next = REMINDER

    def end(self) -> None:
        """Note that there is a client, or that none is needed."""
        self.since, self._next = None, REMINDER

    def seconds(self, now: float) -> float:
        """Return how long no client has been there."""
        if self.since is None:
            self.since = now
        return now - self.since

    def remind(self, seconds: float, host: str, port: int) -> None:
        """Say in the log what to start, if it is time to."""
        if seconds <= self._next:
            return
        self._next += min(self._next, 60.0)
        log.warning(
            "no simulator has connected to %s for %.0f s; start one with "
            "`python -m verifai_jax.remote_client --address %s MODULE:FUNCTION`",
            (host, port),
            seconds,
            f"[{host}]:{port}" if ":" in host else f"{host}:{port}",
        )
