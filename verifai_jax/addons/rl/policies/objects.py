"""Policies of objects: models and functions of other frameworks, in JAX if possible.

policy = from_object(model, observation=np.zeros(8))
"""

import contextlib
import inspect
import io
import logging
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Key, PyTree

from verifai_jax.addons.rl.policies.base import Policy
from verifai_jax.addons.rl.policies.errors import PolicyError, refused
from verifai_jax.addons.rl.policies.onnx_graph import read_onnx
from verifai_jax.addons.rl.policies.sb3 import read_sb3
from verifai_jax.addons.simulators.environments.episode import count_required, without_extras
from verifai_jax.core.compute.purity import AS_MEMORY, watch, why_differs
from verifai_jax.core.messages.errors import require
from verifai_jax.core.messages.text import format_seconds, one_line
from verifai_jax.core.store.foreign_files import read_json
from verifai_jax.core.user_code.kept_state import changed, holds_tracer, state_of
from verifai_jax.core.user_code.user_errors import defined_at

log = logging.getLogger("verifai_jax.policies")


def from_object(source: Any, observation: ArrayLike | None, batched: bool) -> Policy:
    """Return the policy of a model or function, as `policy` does; refuse any other object."""
    root = type(source).__module__.partition(".")[0]
    if root in ("stable_baselines3", "sb3_contrib"):
        return _of_sb3(source)
    if _is_a(source, "torch.nn.modules.module", "Module"):
        return _of_torch(source, observation, batched)
    pair = isinstance(source, tuple) and len(source) == 2
    if pair and callable(getattr(source[0], "apply", None)):
        return Policy(source[1], _Of(_linen, source[:1]))
    if _is_a(source, "flax.nnx.module", "Module"):
        nnx = require("flax.nnx", extra="policies")
        # A copy, so that the user's stays in training.
        evaluated = nnx.merge(*nnx.split(source))
        evaluated.eval()
        graph, state = nnx.split(evaluated)
        return Policy(state, _Of(_nnx, (graph,)))
    if not callable(source):
        raise PolicyError(
            "a policy is a file, a model or a function of the observation; got "
            f"{type(source).__name__}. For a flax module give (module, variables)"
        )
    if _is_a(source, "equinox._module._module", "Module"):
        source = require("equinox", extra="policies").nn.inference_mode(source)
    leaves, structure = jax.tree.flatten(source)
    if leaves and leaves != [source]:
        arrays = [leaf if isinstance(leaf, jax.Array | np.ndarray) else None for leaf in leaves]
        rest = tuple(leaf if a is None else None for a, leaf in zip(arrays, leaves, strict=True))
        return Policy(arrays, _Of(partial(_rebuilt, structure, rest)))
    kind = RandomPolicy if count_required(source) == 2 else Policy
    return kind((), _Function(source, batched))


def _is_a(source: object, module: str, name: str) -> bool:
    """Return whether an object's class descends from one of a library that may not be installed."""
    return any((c.__module__, c.__name__) == (module, name) for c in type(source).__mro__)


class RandomPolicy(Policy):
    """A random policy: a function of `(observation, key)`, such as those of Brax."""

    def as_graph(self, observation: PyTree = None) -> Any:
        """Raise an error, because a graph of ONNX operators cannot draw random numbers."""
        raise PolicyError("a random policy cannot be saved: give its deterministic function")

    def act(self, observation: PyTree, key: Key[Array, ""]) -> Any:
        """Return an action drawn with the random key of the step."""
        return self.actions(without_extras(self.compute.function(observation, key)))  # pyright: ignore


jax.tree_util.register_dataclass(
    RandomPolicy, ["weights", "initial_memory", "normaliser"], ["compute", "actions"]
)


@dataclass(frozen=True)
class _Of:
    """The function of a network without memory: `function(*fixed, weights, observation)`."""

    function: Callable[..., Any]
    fixed: tuple[Any, ...] = ()

    def __call__(self, weights: PyTree, observation: PyTree, memory: None) -> tuple[Any, None]:
        return without_extras(self.function(*self.fixed, weights, observation)), None


def _linen(module: Any, variables: PyTree, observation: PyTree) -> Any:
    takes = inspect.signature(type(module).__call__).parameters
    known = {"train": False, "training": False, "is_training": False, "deterministic": True}
    try:
        options = {name: value for name, value in known.items() if name in takes}
        return module.apply(variables, observation, **options)
    except Exception as error:
        if not type(error).__module__.startswith("flax"):
            raise
        why = "cannot be applied to an observation, as if it were in training"
        name = type(module).__name__
        raise PolicyError(f"{name} {why}: {one_line(str(error), 300)}") from error


def _nnx(graph: Any, state: PyTree, observation: PyTree) -> Any:
    return require("flax.nnx", extra="policies").merge(graph, state)(observation)


def _rebuilt(structure: Any, rest: Sequence[Any], weights: Sequence[Any], seen: PyTree) -> Any:
    leaves = [r if w is None else w for w, r in zip(weights, rest, strict=True)]
    return jax.tree.unflatten(structure, leaves)(seen)


def _brax(make: Callable[..., Any], weights: PyTree, observation: PyTree) -> Any:
    return make(weights, deterministic=True)(observation, jax.random.key(0))


@dataclass(frozen=True, eq=False)
class _Function:
    """A Python function: traced by JAX if possible, otherwise called on the host, or `batched`."""

    function: Callable[..., Any]
    batched: bool = False

    @cached_property
    def forms(self) -> dict[Any, Any]:
        """Shapes of observations with the form of the action on the host; None if JAX traces it."""
        return {}

    def __call__(self, weights: PyTree, observation: PyTree, memory: None) -> tuple[Any, None]:
        key = str(jax.tree.map(_abstract, observation))
        if key not in self.forms:
            before = state_of(self.function)
            try:
                pure_program(self.function, observation)
                self.forms[key] = None
            except PolicyError:
                raise
            except Exception as error:
                after = state_of(self.function)
                held = [name for name in changed(before, after) if holds_tracer(after, name)]
                if held:
                    raise _impure(self.function, why_differs(held)) from error
                self.forms[key] = self._form(observation, error)
        if self.forms[key] is None:
            return jax.tree.map(jnp.asarray, without_extras(self.function(observation))), None
        method, form = "broadcast_all" if self.batched else "sequential", self.forms[key]
        return jax.pure_callback(self._on_host, form, observation, vmap_method=method), None

    def _on_host(self, observation: PyTree) -> Any:
        seen = jax.tree.map(np.asarray, observation)
        return jax.tree.map(_plain, returned(self.function, self.function(seen)))

    def _form(self, observation: PyTree, error: Exception) -> Any:
        """Return the form of the action on the host, after checks, and log the time of a call."""
        forms = jax.tree.map(_abstract, observation)
        zeros = jax.tree.map(lambda o: np.zeros(o.shape, o.dtype), forms)
        before, begun = state_of(self.function), time.perf_counter()
        action = self._on_host(zeros)
        took = time.perf_counter() - begun
        with contextlib.suppress(ArithmeticError, LookupError, ValueError):
            # Between two calls that are the same, one with another observation.
            self._on_host(jax.tree.map(lambda o: (o + 0.1).astype(o.dtype), zeros))
        again = self._on_host(zeros)
        kept = changed(before, state_of(self.function))
        if not all(map(np.array_equal, jax.tree.leaves(action), jax.tree.leaves(again))):
            raise _impure(self.function, why_differs(kept))
        log.warning(
            "the policy%s runs in Python, %s a call, because JAX cannot trace it: %s",
            defined_at(self.function), format_seconds(took, 2), one_line(str(error), 200),
        )  # fmt: skip
        return jax.tree.map(_abstract, action)


def returned(function: Callable[..., Any], made: Any) -> Any:
    """Return the action that a function has returned, without extras; refuse None."""
    if made is None:
        where = defined_at(function)
        raise PolicyError(f"the policy{where} returned None: it may lack a return statement")
    return without_extras(made)


def pure_program(function: Callable[..., Any], *arguments: PyTree) -> Any:
    """Return the program of a policy, traced by JAX; refuse one that returns None, or remembers."""
    forms = jax.tree.map(_abstract, arguments)
    # A new function each time: JAX remembers what it traced by the function.
    trace = lambda: jax.make_jaxpr(lambda *a: returned(function, function(*a)))(*forms)  # noqa: E731
    watched = watch(function, trace)
    if watched.why_impure is not None:
        raise _impure(function, watched.why_impure)
    return watched.result


def _impure(function: Callable[..., Any], why: str) -> PolicyError:
    return PolicyError(
        f"the policy{defined_at(function)} {why}, and vj.policy takes functions of the observation "
        "alone, or of (observation, key) with a random key. An object with a method reset() may be "
        f"given to vj.gymnasium without vj.policy. {AS_MEMORY}"
    )


def _abstract(value: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(jnp.shape(value), jnp.result_type(value))


def _plain(value: Any) -> np.ndarray:
    """Return a number or array of any framework as a NumPy value that JAX accepts."""
    value = value.detach().cpu().numpy() if hasattr(value, "detach") else value
    array = np.asarray(value)
    return array.astype(jax.dtypes.canonicalize_dtype(array.dtype))


def _of_sb3(model: Any) -> Policy:
    file = io.BytesIO()
    model.save(file)
    try:
        return read_sb3(file.getvalue(), f"the model {type(model).__name__}")
    except PolicyError as error:
        log.warning("%s; it runs in Python until then", error)
        return Policy((), _Function(lambda seen: model.predict(seen, deterministic=True)[0], True))


def _of_torch(module: Any, observation: ArrayLike | None, batched: bool) -> Policy:
    """Return a module of PyTorch, translated by ONNX, or as a function of the host."""
    if observation is None:
        raise PolicyError("for a torch module give observation= as well, an example of its input")
    torch = require("torch", extra="policies")
    require("onnx", extra="policies")
    example = np.asarray(observation, np.float32)
    module = module.eval()

    def on_host(seen: np.ndarray) -> Any:
        batch = torch.as_tensor(np.array(seen, np.float32)).reshape(-1, *example.shape)
        with torch.no_grad():
            made = module(batch)
        return made[0] if np.ndim(seen) == example.ndim else made

    try:
        return _translated(torch, module, example, on_host)
    except Exception as error:
        why = one_line(str(error), 300)
        log.warning("the torch module runs in Python, because it cannot be translated: %s", why)
        return Policy((), _Function(on_host, batched))


def _translated(
    torch: Any, module: Any, example: np.ndarray, on_host: Callable[..., Any]
) -> Policy:
    """Return a module of PyTorch in JAX if both agree: an exporter follows one branch only."""
    file = io.BytesIO()
    # It prints the whole graph where it fails.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        inputs = (torch.as_tensor(example)[None],)
        torch.onnx.export(module, inputs, file, dynamo=False, input_names=["observation"])
    graph, weights, memory = read_onnx(None, file.getvalue(), "the torch module")
    policy = Policy(weights, graph, memory)
    if memory is None:
        draws = np.random.default_rng(0).normal(size=(32, *example.shape)).astype(np.float32)
        scales = np.array([0.1, 1.0, 10.0, 1.0], np.float32)
        for seen, scale in zip(draws, np.resize(scales, len(draws)), strict=True):
            one, other = np.asarray(policy.act(seen * scale)), _plain(on_host(seen * scale))
            if one.shape != other.shape or not np.allclose(one, other, rtol=1e-3, atol=1e-4):
                why = "its translation gives other actions, as for a module with branches"
                raise ValueError(why)
    return policy


def read_brax(folder: Path) -> Policy:
    """Return the deterministic policy of a PPO checkpoint of Brax or Playground."""
    networks = require("brax.training.agents.ppo.networks", extra="brax")
    known = require("brax.training.networks", extra="brax").ACTIVATION
    statistics = require("brax.training.acme.running_statistics", extra="brax")
    with refused(f"{folder} holds no checkpoint of Brax' PPO"):
        config = read_json(folder / "ppo_network_config.json", within=folder)
        # Brax 0.14.2 refuses a checkpoint of its own whose initialisers are not named; a trained
        # network needs none.
        given = config["network_factory_kwargs"].items()
        options = {n: v for n, v in given if v is not None and "kernel_init" not in n}
        if "activation" in options:
            options["activation"] = known[options["activation"]]
        if config["normalize_observations"]:
            options["preprocess_observations_fn"] = statistics.normalize
        sizes = config["observation_size"], config["action_size"]
        made = networks.make_ppo_networks(*sizes, **options)
        weights = require("brax.training.checkpoint", extra="brax").load(folder)
    return Policy(weights, _Of(_brax, (networks.make_inference_fn(made),)))
