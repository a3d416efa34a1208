"""A package of a third party: a kind of system, a search, a command and a section of reports."""

from dataclasses import dataclass
from typing import Any

import click
import jax
import jax.numpy as jnp

import verifai_jax as vj
from verifai_jax.addons.reports.markup import table
from verifai_jax.addons.reports.page import Section, before_limits
from verifai_jax.search.base import Observations


@dataclass(frozen=True)
class Tank(vj.System):
    """A water tank with an inflow and an outlet, which `vj.tank(duration=60)` makes."""

    duration: float = 30.0
    dt: float = 0.1

    def __call__(self, features: Any, key: Any = None) -> vj.Trace:
        def step(level: Any, _: Any) -> tuple[Any, Any]:
            flow = features["inflow"] - features["outlet"] * jnp.sqrt(jnp.maximum(level, 0.0))
            return level + self.dt * flow, level

        samples = round(self.duration / self.dt) + 1
        _, level = jax.lax.scan(step, jnp.asarray(features["level0"], float), None, samples)
        return vj.Trace({"level": level}, dt=self.dt)


@dataclass(frozen=True)
class Edges(vj.search.Search):
    """Points of the prior with one coordinate at an end of its range, `search="edges"`."""

    margin: float = 0.01

    @property
    def learns(self) -> bool:
        return False

    def init(self, key: Any, cube: Any, batch: int) -> Any:
        return key, jnp.uint32(0)

    def ask(self, state: Any, cube: Any, batch: int) -> Any:
        key, index = state

        def point(number: Any) -> Any:
            draw, which, side = jax.random.split(jax.random.fold_in(key, number), 3)
            u = jax.random.uniform(draw, (cube.dim,))
            end = jnp.where(jax.random.bernoulli(side), 1.0 - self.margin, self.margin)
            return u.at[jax.random.randint(which, (), 0, cube.dim)].set(end)

        return jax.vmap(point)(index + jnp.arange(batch, dtype=jnp.uint32)), (key, index + batch)

    def tell(self, state: Any, cube: Any, observations: Observations) -> Any:
        return state


@click.command()
@click.argument("folder")
def extremes(folder: str) -> None:
    """Print the extreme values of each feature among the violations of the run in FOLDER."""
    run = vj.load(folder)
    for name in run.table.features:
        values = run.table.counterexamples[name]
        click.echo(f"{name}: {values.min():.4g} to {values.max():.4g}")


@dataclass(frozen=True)
class Ranges:
    """A section on the features of violations: `verifai-jax report FOLDER --section ranges`."""

    run: vj.Run

    def on_page(self, page: Any) -> Any:
        """Return the page of a report with this section."""
        found = self.run.table.counterexamples
        rows = [
            (name, f"{found[name].min():.4g}", f"{found[name].max():.4g}")
            for name in self.run.table.features
        ]
        content = (table(["feature", "least", "greatest"], rows),)
        return before_limits(page, Section("ranges", "Where violations lie", content))
