"""Constants of a MuJoCo model that follow from its masses and geometry, for changed features.

- `recompute_inertia`: mass, centre and inertia of bodies whose geoms change, at constant density
  (or at the mass that a geom states); for both backends.
- `recompute_constants`: the constants that `mj_setConst` computes and MJX reads:
  `body_subtreemass`, `body_invweight0`, `dof_invweight0`, `tendon_length0`, `tendon_invweight0`,
  `actuator_acc0` and `geom_rbound`, in JAX. The native backend calls `mj_setConst` itself.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.addons.simulators.mujoco.model import MjSpec, MjxModel, Model, mjx_module
from verifai_jax.addons.simulators.mujoco.part_paths import GEOM_MASS, MjModel
from verifai_jax.core.compute.devices import enable_compile_cache

_PLANE, _HFIELD, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX = range(7)
_SHAPES = (_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX)
Leaves = dict[str, Float[Array, "..."]]


@dataclass(frozen=True)
class SolidBody:
    """A body whose mass and inertia are computed from its geoms.

    - `geoms`: indices of its geoms; `kinds`: their MuJoCo types.
    - `masses`: the geoms' masses in kg, None if the model gives no mass.
    - `densities`: the geoms' densities in kg/m^3.
    - `bound`: whether a feature sets a geom's mass.
    """

    body: int
    geoms: tuple[int, ...]
    kinds: tuple[int, ...]
    masses: tuple[float | None, ...]
    densities: tuple[float, ...]
    bound: tuple[bool, ...]


def bodies_of_geoms(
    model: Model, changed: Collection[int], massive: Mapping[int, str] | None = None
) -> tuple[SolidBody, ...]:
    """Return the bodies with a `changed` geom whose inertia is computed from geoms.

    The inertia is kept in a model without a spec, and for a body with an explicit `<inertial>`.

    **Arguments:**
    - `model`: the model with its spec.
    - `changed`: indices of geoms with a new size or location.
    - `massive`: indices of geoms with a new mass, and the paths that set it.
    **Raises:** `ValueError` for a body whose inertia cannot be computed here (meshes, shells), and
    for the mass of a geom that does not contribute to its body's mass.
    """
    compiled, spec, massive = model.compiled, model.spec, massive or {}
    changed = {*changed, *massive}
    if not changed:
        return ()
    solids = () if spec is None else _solids(compiled, spec, changed, massive)
    found = {geom for solid in solids for geom in solid.geoms}
    for geom, path in massive.items():
        if geom not in found:
            body = compiled.body(int(compiled.geom_bodyid[geom])).name
            raise ValueError(
                f"{path!r}: the inertia of body {body!r} is given explicitly, not computed from "
                f"its geoms; bind 'body/{body}/mass' instead"
                if body != "world"
                else f"{path!r}: the world has no mass"
            )
    return solids


def _solids(
    compiled: MjModel, spec: MjSpec, changed: Collection[int], massive: Mapping[int, str]
) -> tuple[SolidBody, ...]:
    mode = int(spec.compiler.inertiafromgeom)  # 0 never, 1 always, 2 where none is given
    stated = {body.id: bool(body.explicitinertial) for body in spec.bodies}
    low, high = spec.compiler.inertiagrouprange
    geoms = {geom.id: geom for geom in spec.geoms}
    solids = []
    for body in sorted({int(compiled.geom_bodyid[g]) for g in changed}):
        if body == 0 or mode == 0 or (mode == 2 and stated[body]):
            continue
        first, count = int(compiled.body_geomadr[body]), int(compiled.body_geomnum[body])
        parts = []
        for g in range(first, first + count):
            if not low <= int(compiled.geom_group[g]) <= high:
                continue
            mass = None if math.isnan(geoms[g].mass) else float(geoms[g].mass)
            if g in massive or (mass if mass is not None else geoms[g].density) > 0:
                kind, density = int(compiled.geom_type[g]), float(geoms[g].density)
                parts.append((g, kind, mass, density, g in massive))
        if not parts:
            continue
        solid = SolidBody(body, *(tuple(column) for column in zip(*parts, strict=True)))  # pyright: ignore[reportArgumentType]
        _check_solid(compiled, solid)
        solids.append(solid)
    return tuple(solids)


def _check_solid(compiled: MjModel, solid: SolidBody) -> None:
    """Refuse a body whose recomputed inertia is not the one that MuJoCo compiled."""
    name = compiled.body(solid.body).name
    advice = f"give body {name!r} an <inertial>, which is then kept"
    if not set(solid.kinds) <= set(_SHAPES):
        raise ValueError(
            f"a geom of body {name!r} is bound, but the body's mass comes from a shape other than "
            f"sphere, capsule, ellipsoid, cylinder and box; {advice}"
        )
    names = ("geom_size", "geom_pos", "geom_quat", "body_mass", "body_inertia", "body_ipos")
    with jax.enable_x64():
        enable_compile_cache()
        leaves = {n: jax.device_put(getattr(compiled, n)) for n in (*names, "body_iquat")}
        leaves[GEOM_MASS] = jax.device_put(masses_of_geoms(compiled, (solid,)))
        again = jax.jit(lambda leaves: recompute_inertia(compiled, (solid,), leaves))(leaves)
        again = {name: np.asarray(again[name]) for name in ("body_mass", "body_inertia")}
    same = np.allclose(again["body_mass"], compiled.body_mass, rtol=1e-6) and np.allclose(
        np.sort(again["body_inertia"][solid.body]),
        np.sort(compiled.body_inertia[solid.body]),
        rtol=1e-6,
    )
    if not same:
        raise ValueError(
            f"a geom of body {name!r} is bound, whose inertia MuJoCo did not compute from solid "
            f"geoms (a shell, a total mass, a lower bound); {advice}"
        )


def masses_of_geoms(compiled: MjModel, solids: Collection[SolidBody]) -> np.ndarray:
    """Return the mass of each geom of these bodies in the model, in kg; NaN for other geoms."""
    masses = np.full(compiled.ngeom, np.nan)
    for solid in solids:
        for geom, kind, mass, density in zip(
            solid.geoms, solid.kinds, solid.masses, solid.densities, strict=True
        ):
            size = compiled.geom_size[geom]
            masses[geom] = density * _volume(kind, size) if mass is None else mass
    return masses


def recompute_inertia(compiled: MjModel, solids: Collection[SolidBody], leaves: Leaves) -> Leaves:
    """Return the leaves with mass, centre and inertia of the `solids` computed from their geoms."""
    leaves = dict(leaves)
    for solid in solids:
        parts = [
            _geom(leaves, compiled, geom, kind, leaves[GEOM_MASS][geom] if bound else mass, density)
            for geom, kind, mass, density, bound in zip(
                *(solid.geoms, solid.kinds, solid.masses, solid.densities, solid.bound), strict=True
            )
        ]
        mass, centre, inertia, quat = parts[0] if len(parts) == 1 else _combine(parts)
        for name, value in (
            ("body_mass", mass),
            ("body_ipos", centre),
            ("body_inertia", inertia),
            ("body_iquat", quat),
        ):
            leaves[name] = leaves[name].at[solid.body].set(value)
    return leaves


def _geom(
    leaves: Leaves, compiled: MjModel, geom: int, kind: int, mass: Any, density: float
) -> tuple[Array, Array, Array, Array]:
    """Return mass, centre, principal inertia and its orientation of a geom, in its body's frame."""

    def leaf(name: str) -> Array:
        if name in leaves:
            return leaves[name][geom]
        return jnp.asarray(getattr(compiled, name)[geom], leaves["body_mass"].dtype)

    size = leaf("geom_size")
    total = jnp.asarray(mass if mass is not None else density * _volume(kind, size), size.dtype)
    return total, leaf("geom_pos"), total * _inertia(kind, size), leaf("geom_quat")


def _volume(kind: int, size: Float[Array, "3"] | Float[np.ndarray, "3"]) -> Any:
    a, b, c = size
    if kind == _SPHERE:
        return 4 / 3 * math.pi * a**3
    if kind == _CAPSULE:
        return math.pi * a**2 * (2 * b + 4 / 3 * a)
    if kind == _CYLINDER:
        return 2 * math.pi * a**2 * b
    return (4 / 3 * math.pi if kind == _ELLIPSOID else 8.0) * a * b * c


def _inertia(kind: int, size: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the principal moments for unit mass, in the geom's frame."""
    a, b, _c = size
    if kind == _SPHERE:
        return jnp.full(3, 0.4, size.dtype) * a**2
    if kind == _CYLINDER:
        side = (3 * a**2 + 4 * b**2) / 12
        return jnp.stack([side, side, a**2 / 2])
    if kind == _CAPSULE:
        # A cylinder of half length b, and two half balls whose centres of mass are 3/8 a further.
        cylinder = 2 * b / (2 * b + 4 / 3 * a)
        ball = 1 - cylinder
        side = cylinder * (3 * a**2 + 4 * b**2) / 12
        side = side + ball * (0.4 * a**2 + b**2 + 0.75 * a * b)
        return jnp.stack([side, side, cylinder * a**2 / 2 + ball * 0.4 * a**2])
    squares = size**2
    return (jnp.sum(squares) - squares) / (5 if kind == _ELLIPSOID else 3)


def _combine(parts: list[Any]) -> tuple[Array, Array, Array, Array]:
    masses, centres = (jnp.stack([part[i] for part in parts]) for i in range(2))
    mass = jnp.sum(masses)
    centre = masses @ centres / mass
    full = jnp.zeros((3, 3), centre.dtype)
    for own, position, moments, quat in parts:
        turn, arm = _rotation(quat), position - centre
        full = full + (turn * moments) @ turn.T
        full = full + own * (jnp.dot(arm, arm) * jnp.eye(3, dtype=arm.dtype) - jnp.outer(arm, arm))
    moments, axes = jnp.linalg.eigh(full)
    # A rotation, not a reflection.
    axes = axes.at[:, 2].multiply(jnp.sign(jnp.linalg.det(axes)))
    return mass, centre, moments, _quaternion(axes)


def _rotation(quat: Float[Array, "4"]) -> Float[Array, "3 3"]:
    w, x, y, z = quat / jnp.linalg.norm(quat)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(matrix: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Return the quaternion of a rotation, by the one of four formulas that divides by the most."""
    m = matrix
    signs = jnp.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], m.dtype)
    squares = 1 + signs @ jnp.diag(m)
    candidates = jnp.array(
        [
            [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]],
        ]
    )
    best = candidates[jnp.argmax(squares)]
    return best / jnp.linalg.norm(best)


def recompute_constants(model: MjxModel) -> Any:
    """Return an MJX model with the constants that `mj_setConst` computes from its other leaves.

    Source: MuJoCo, engine_setconst.c (set0 and setFixed); see "Computation: Model" in its manual.
    """
    mjx = mjx_module()
    masses = model.body_mass
    subtree = masses
    for body in range(model.nbody - 1, 0, -1):
        subtree = subtree.at[model.body_parentid[body]].add(subtree[body])
    model = model.replace(body_subtreemass=subtree, geom_rbound=_bounds(model))
    if model.nv == 0:
        return model
    data = mjx.make_data(model).replace(qpos=model.qpos0)
    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.tendon_armature(model, mjx.crb(model, mjx.tendon(model, data)))
    data = mjx.transmission(model, data)
    inverse = jnp.linalg.inv(mjx.full_m(model, data))
    bodies = []
    for body in range(model.nbody):
        if model.body_weldid[body] == 0:
            bodies.append(jnp.zeros(2, masses.dtype))
            continue
        if model.body_simple[body] == 2:  # It slides and does not turn.
            bodies.append(jnp.array([1.0, 0.0], masses.dtype) / masses[body])
            continue
        jacobians = mjx.jac(model, data, data.xipos[body], body)
        bodies.append(jnp.stack([jnp.einsum("ik,ij,jk->", j, inverse, j) / 3 for j in jacobians]))
    dofs = jnp.diag(inverse)
    for joint, kind in enumerate(model.jnt_type):
        first = int(model.jnt_dofadr[joint])
        for start in {0: (first, first + 3), 1: (first,)}.get(int(kind), ()):
            part = slice(start, start + 3)
            dofs = dofs.at[part].set(jnp.mean(dofs[part]))
    moment, pull = data._impl.actuator_moment, data._impl.ten_J
    return model.tree_replace(
        {
            "body_invweight0": jnp.stack(bodies),
            "dof_invweight0": dofs,
            "tendon_length0": data.ten_length,
            "tendon_invweight0": jnp.einsum("ti,ij,tj->t", pull, inverse, pull),
            "actuator_acc0": jnp.linalg.norm(moment @ inverse, axis=-1),
        }
    )


def _bounds(model: MjxModel) -> Float[Array, " ngeom"]:
    """Return the radius of the ball around each geom, where features can change it."""
    bounds = model.geom_rbound
    for geom, kind in enumerate(model.geom_type):
        size = model.geom_size[geom]
        radius = {
            _SPHERE: lambda s: s[0],
            _CAPSULE: lambda s: s[0] + s[1],
            _CYLINDER: lambda s: jnp.sqrt(s[0] ** 2 + s[1] ** 2),
            _ELLIPSOID: jnp.max,
            _BOX: lambda s: jnp.sqrt(jnp.sum(s**2)),
        }.get(int(kind))
        if radius is not None:
            bounds = bounds.at[geom].set(radius(size))
    return bounds
