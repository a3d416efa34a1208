"""Images: values and gradients against finite differences, depth and edges against a ray caster."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from verifai_jax.addons.perception import (
    Box,
    Camera,
    Conditions,
    Cone,
    Cross,
    Cylinder,
    Disc,
    Ground,
    Line,
    Rectangle,
    Ring,
    Scene,
    Sphere,
    Sun,
    facing,
    hsv,
)
from verifai_jax.addons.perception.camera import coverage, strip
from verifai_jax.addons.perception.conditions import blurred

RED, GREEN, BLUE, YELLOW = (0.9, 0.1, 0.1), (0.1, 0.8, 0.2), (0.1, 0.2, 0.9), (0.9, 0.8, 0.1)

SOLIDS = (
    Box((6.0, 1.0, 0.0), (2.0, 1.2, 1.0), RED, yaw=0.4),
    Cone((4.5, -0.8, 0.0), 0.4, 1.1, GREEN),
    Cylinder((7.0, -2.0, 0.0), 0.5, 1.4, BLUE),
    Cylinder((5.0, 0.3, 0.3), 0.3, 1.0, YELLOW, axis=(0.3, 1.0, 0.0)),
    Sphere((5.5, -1.6, 0.6), 0.5, YELLOW),
)
MARKINGS = (
    Line((0.0, 2.0), yaw=0.1, width=0.3),
    Line((0.0, -3.0), width=0.3, dash=1.0, gap=0.7),
    Rectangle((4.0, 2.0), (1.5, 0.8), RED, yaw=0.3),
    Disc((3.0, -1.0), 0.7, BLUE),
    Ring((3.0, -1.0), 1.2, 0.2),
    Cross((8.0, 0.5), 1.5, 0.4, yaw=0.2),
)
EYES = {
    "driving": {"position": (0.0, 0.0, 1.3), "pitch": -0.05},
    "rolled": {"position": (-1.0, -2.0, 3.0), "yaw": 0.3, "pitch": -0.35, "roll": 0.3},
    "flying": {"position": (5.0, -0.4, 9.0), "yaw": 0.2, "pitch": -math.pi / 2},
}


# --- an independent ray caster -------------------------------------------------------------------


def frame_of(solid) -> np.ndarray:
    """Return the axes of a solid as rows."""
    if isinstance(solid, Box):
        cos, sin = math.cos(solid.yaw), math.sin(solid.yaw)
        return np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    axis = np.array(solid.axis) / np.linalg.norm(solid.axis)
    first = np.linalg.svd(axis[None])[2][1]
    return np.stack([first, np.cross(axis, first), axis])


def hit(solid, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the distances, in lengths of the rays, at which rays meet a solid first."""
    position = np.array(solid.position)
    if isinstance(solid, Sphere):
        away = eye - position
        a, b = (rays**2).sum(-1), rays @ away
        root = b**2 - a * (away @ away - solid.radius**2)
        return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    frame = frame_of(solid)
    o, d = frame @ (eye - position), rays @ frame.T
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(solid, Box):
            length, width, height = solid.size
            low, high = (
                np.array([-length / 2, -width / 2, 0]),
                np.array([length / 2, width / 2, height]),
            )
            near = np.minimum((low - o) / d, (high - o) / d).max(-1)
            far = np.maximum((low - o) / d, (high - o) / d).min(-1)
            return np.where((near < far) & (near > 0), near, np.inf)
        taper = solid.radius / solid.height if isinstance(solid, Cone) else 0.0
        here = solid.radius - taper * o[2]
        a = d[..., 0] ** 2 + d[..., 1] ** 2 - (taper * d[..., 2]) ** 2
        b = d[..., :2] @ o[:2] + taper * here * d[..., 2]
        root = b**2 - a * (o[:2] @ o[:2] - here**2)
        times = [(-b - np.sqrt(root)) / a, (-b + np.sqrt(root)) / a]
        found = []
        for time in times:
            z = o[2] + time * d[..., 2]
            found.append(np.where((time > 0) & (z >= 0) & (z <= solid.height), time, np.inf))
        for z, radius in ((0.0, solid.radius), (solid.height, solid.radius - taper * solid.height)):
            time = (z - o[2]) / d[..., 2]
            at = o[:2] + time[..., None] * d[..., :2]
            found.append(np.where((time > 0) & ((at**2).sum(-1) <= radius**2), time, np.inf))
    return np.nanmin(np.stack([np.where(np.isnan(t), np.inf, t) for t in found]), axis=0)


def paint(marking, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return where the ground has a marking."""
    x, y = x - marking.position[0], y - marking.position[1]
    cos, sin = math.cos(getattr(marking, "yaw", 0.0)), math.sin(getattr(marking, "yaw", 0.0))
    along, left = x * cos + y * sin, y * cos - x * sin
    if isinstance(marking, Line):
        dashed = np.mod(along, marking.dash + marking.gap) < marking.dash
        return (np.abs(left) < marking.width / 2) & dashed
    if isinstance(marking, Rectangle):
        return (np.abs(along) < marking.size[0] / 2) & (np.abs(left) < marking.size[1] / 2)
    if isinstance(marking, Cross):
        long, short = marking.size / 2, marking.width / 2
        return (np.maximum(np.abs(along) / long, np.abs(left) / short) < 1) | (
            np.maximum(np.abs(along) / short, np.abs(left) / long) < 1
        )
    if isinstance(marking, Disc):
        return np.hypot(x, y) < marking.radius
    return np.abs(np.hypot(x, y) - marking.radius) < marking.width / 2


def cast(scene: Scene, camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, colour and what is met, of `samples` times as many pixels each way."""
    rays = camera.rays()
    right, down, forward = (np.array(v, float) for v in (rays.right, rays.down, rays.forward))
    eye, focal = np.array(camera.position, float), float(rays.focal)
    rows, columns = camera.height * samples, camera.width * samples
    v = ((np.arange(rows) + 0.5) / samples - camera.height / 2) / focal
    u = ((np.arange(columns) + 0.5) / samples - camera.width / 2) / focal
    d = forward + v[:, None, None] * down + u[None, :, None] * right
    with np.errstate(divide="ignore"):
        depth = np.where(d[..., 2] < 0, -eye[2] / d[..., 2], np.inf)
    x, y = (eye[k] + np.where(np.isinf(depth), 1e6, depth) * d[..., k] for k in range(2))
    colour = np.where(np.isinf(depth)[..., None], scene.sky.horizon, scene.ground.colour)
    for marking in scene.ground.markings:
        there = np.isfinite(depth) & paint(marking, x, y)
        colour = np.where(there[..., None], marking.colour, colour)
    met = np.where(np.isinf(depth), -2, -1)
    for number, solid in enumerate(scene.solids):
        t = hit(solid, eye, d)
        colour = np.where((t < depth)[..., None], solid.colour, colour)
        met = np.where(t < depth, number, met)
        depth = np.minimum(t, depth)
    return depth, colour, met


def blocks(image: np.ndarray, samples: int) -> np.ndarray:
    """Return the samples of each pixel: `[height, width, samples^2, ...]`."""
    height, width = image.shape[0] // samples, image.shape[1] // samples
    parts = image.reshape(height, samples, width, samples, *image.shape[2:])
    return parts.swapaxes(1, 2).reshape(height, width, samples**2, *image.shape[2:])


def flat(scene: Scene) -> Scene:
    """Return the scene in light from everywhere, under a sky of one colour."""
    sky = dataclasses.replace(scene.sky, zenith=scene.sky.horizon)
    return dataclasses.replace(scene, sun=Sun(ambient=1.0, shadows=False), sky=sky)


FAR_AND_THIN = (
    Box((-20.0, 0.5, 0.0), (2.0, 1.0, 1.0), RED),  # behind, as those at -500 m
    Cone((40.0, -3.0, 0.0), 0.25, 0.75, GREEN),
    Cylinder((-500.0, -1.0, 0.0), 0.2, 1.0, BLUE),
    Cylinder((12.0, 1.5, 0.3), 0.3, 1.0, YELLOW, axis=(1.0, -0.05, 0.0)),  # seen along its axis
    Sphere((-500.0, 2.0, 1.0), 0.5, YELLOW),
)
FAR_MARKINGS = (
    Line((0.0, -6.0), width=0.1),
    Line((0.0, 3.0), width=0.1, dash=2.0, gap=2.0),
    Rectangle((70.0, 0.0), (8.0, 1.0), RED),
    Disc((80.0, 4.0), 2.0, BLUE),
    Ring((60.0, -8.0), 1.5, 0.3),
    Cross((-30.0, 0.0), 4.0, 1.0),
)
"""As many of each kind as above: both scenes are rendered by one program."""


@pytest.fixture(scope="module")
def views():
    """Return depth and image of a scene from each eye, as rendered."""
    near = flat(Scene(SOLIDS, Ground((0.3, 0.3, 0.3), MARKINGS)))
    far = flat(Scene(FAR_AND_THIN, Ground((0.3, 0.3, 0.3), FAR_MARKINGS)))
    both = jax.jit(lambda scene, camera: (scene.depth(camera), scene.render(camera)))
    cameras = {name: Camera(24, 36, field_of_view=1.0, **eye) for name, eye in EYES.items()}
    cameras["far"] = Camera(24, 36, 1.0, (0.0, 0.1, 1.3), 0.02, -0.05, 0.0)
    seen = {}
    for name, camera in cameras.items():
        scene = far if name == "far" else near
        seen[name] = (scene, camera, *both(scene, camera))
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("name", [*EYES, "far"])
def test_depth_is_that_of_a_ray_caster(views, name):
    scene, camera, depth, _ = views[name]
    centres, _, what = cast(scene, camera, 1)
    around = blocks(cast(scene, camera, 5)[2], 5)
    whole = (around == what[..., None]).all(-1)  # nothing ends within the pixel
    assert whole.mean() > 0.6
    np.testing.assert_allclose(np.array(depth)[whole], centres[whole], rtol=2e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("name", [*EYES, "far"])
def test_colours_are_those_of_a_ray_caster_with_many_samples(views, name):
    scene, camera, _, image = views[name]
    exact = blocks(cast(scene, camera, 9)[1], 9).mean(2)
    error = np.abs(np.array(image) - exact).max(-1)
    assert error.mean() < 0.012
    assert np.quantile(error, 0.99) < 0.15


@pytest.mark.slow
def test_shadows_lie_where_the_sun_does_not_come():
    sun = Sun(azimuth=0.7, elevation=0.8, ambient=0.2)
    solids = tuple(solid for solid in SOLIDS if not isinstance(solid, Cylinder))
    scene = Scene(solids, Ground((1.0, 1.0, 1.0)), sun=sun)
    camera = Camera(24, 32, field_of_view=0.9, position=(5.2, -0.4, 9.0), pitch=-math.pi / 2)
    image = np.array(jax.jit(scene.render)(camera))
    depth, _, _ = cast(scene, camera, 1)
    rays = camera.rays()
    d = np.array(rays.linear(jnp.eye(3))).transpose(1, 2, 0)
    points = np.array(camera.position) + depth[..., None] * d
    ground = points[..., 2] < 1e-6
    to_sun = np.array(sun.direction())
    # Rays from the ground to the sun, one by one, for the caster has one eye.
    dark = np.zeros(ground.shape, bool)
    for i, j in zip(*np.nonzero(ground), strict=True):
        dark[i, j] = any(np.isfinite(hit(s, points[i, j], to_sun[None])[0]) for s in solids)
    lit = 0.2 + 0.8 * to_sun[2]
    expected = np.where(dark, 0.2, lit)
    error = np.abs(image[..., 0] - expected)[ground]
    assert dark[ground].sum() > 20
    assert np.mean(error > 0.35) < 0.03  # edges: pixels that are in shadow in part
    assert error.mean() < 0.04


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences():
    weights = np.random.default_rng(0).normal(size=(8, 16, 3))

    def scene_of(p):
        solids = (
            Box(p["box"], p["size"], hsv(p["hue"], 0.8, 0.9), yaw=p["yaw"]),
            Cone(p["cone"], p["radius"], 1.1, GREEN, axis=(0.1, 0.2, 1.0)),
            Sphere(p["sphere"], 0.7, YELLOW),
        )
        markings = (
            Line((0.0, -3.0), yaw=p["line"], width=0.3, dash=1.0, gap=0.7),
            Disc((3.0, -1.0), 0.7, BLUE),
        )
        sun = Sun(p["azimuth"], 0.9, 0.5)
        return Scene(solids, Ground((0.3, 0.3, 0.3), markings), sun=sun)

    def value(p):
        camera = Camera(8, 16, 1.0, p["eye"], p["heading"], -0.1, p["roll"])
        conditions = Conditions(
            fog=p["fog"],
            blur=p["blur"],
            brightness=p["brightness"],
            contrast=0.9,
            saturation=p["saturation"],
            glare=p["glare"],
            glare_at=(0.3, 0.6),
            rain=p["rain"],
            dirt=0.2,
        )
        key = jax.random.key(3)
        return jnp.sum(weights * scene_of(p).render(camera, conditions, key, key))

    with jax.enable_x64(True):
        # Places off the kinks, where a pixel is just covered or just clear.
        p = {
            "box": jnp.array([6.03, 1.02, 0.01]),
            "size": jnp.array([2.0, 1.21, 1.03]),
            "hue": 0.11,
            "yaw": 0.41,
            "cone": jnp.array([4.51, -0.83, 0.01]),
            "radius": 0.43,
            "sphere": jnp.array([5.51, -1.63, 0.72]),
            "line": 0.11,
            "azimuth": 0.71,
            "eye": jnp.array([0.01, 0.02, 1.32]),
            "heading": 0.03,
            "roll": 0.12,
            "fog": 0.02,
            "blur": 0.6,
            "brightness": 0.8,
            "saturation": 0.9,
            "glare": 0.3,
            "rain": 0.4,
        }
        flat_p, unravel = ravel_pytree(jax.tree.map(jnp.asarray, p))
        assert flat_p.dtype == jnp.float64
        of_flat = jax.jit(lambda q: value(unravel(q)))
        gradient = np.array(jax.jit(jax.grad(of_flat))(flat_p))
        steps = 1e-6 * np.eye(flat_p.size)
        differences = [float(of_flat(flat_p + h) - of_flat(flat_p - h)) / 2e-6 for h in steps]
        assert np.isfinite(gradient).all()
        assert (np.abs(gradient) > 1e-4).all()
        np.testing.assert_allclose(gradient, differences, rtol=1e-5, atol=1e-6)


# --- small pieces --------------------------------------------------------------------------------


def test_coverage_of_a_strip_is_its_width():
    places = np.linspace(-2, 2, 401)
    for width in (0.2, 0.7, 1.6):
        shares = np.array(strip(jnp.asarray(places + width / 2), jnp.asarray(width / 2 - places)))
        assert math.isclose(shares.sum() * (places[1] - places[0]), width, rel_tol=1e-3)
    assert coverage(jnp.asarray([-1.0, 0.0, 0.25, 1.0])).tolist() == [0.0, 0.5, 0.75, 1.0]


def test_hues_are_the_colours_of_the_wheel():
    for hue, rgb in {0.0: (1, 0, 0), 1 / 3: (0, 1, 0), 2 / 3: (0, 0, 1), 1 / 6: (1, 1, 0)}.items():
        np.testing.assert_allclose(hsv(hue), rgb, atol=1e-5)
    np.testing.assert_allclose(hsv(0.2, 0.0, 0.7), [0.7] * 3, atol=1e-6)


def test_a_camera_that_faces_a_target_has_it_in_the_middle():
    rays = Camera(
        8, 8, position=(1.0, 2.0, 5.0), **facing((1.0, 2.0, 5.0), (4.0, -1.0, 0.0))
    ).rays()
    away = jnp.asarray([3.0, -3.0, -5.0])
    assert abs(float(away @ rays.right)) < 1e-5
    assert abs(float(away @ rays.down)) < 1e-5
    assert float(away @ rays.forward) > 0


@pytest.mark.thorough
def test_blur_keeps_the_light():
    image = jnp.zeros((3, 9, 12)).at[:, 4, 6].set(1.0)
    seen = blurred(image, 0.8)
    assert math.isclose(float(seen.sum()), 3.0, rel_tol=1e-3)
    assert seen[0, 4, 6] == seen.max() < 0.5


@pytest.mark.parametrize(
    ("scene", "options", "message"),
    [
        (
            Scene((Box((1.0, 2.0), (1.0, 1.0, 1.0)),)),
            {},
            r"position of solids\[0\] \(a Box\) must have 3",
        ),
        (
            Scene((Cone((1.0, 0.0, 0.0), -1.0, 1.0),)),
            {},
            r"radius of solids\[0\] \(a Cone\) must be pos",
        ),
        (Scene(("box",)), {}, r"solids\[0\] is a str; solids are Box"),
        (Scene(ground=Ground(markings=(Box((0, 0, 0), (1, 1, 1)),))), {}, r"markings are Line"),
        (
            Scene(),
            {"camera": Camera(position=(0.0, 0.0, -1.0))},
            r"height of -1 m.*above the ground",
        ),
        (Scene(), {"camera": 3}, r"rendered by a Camera; got int"),
        (Scene(), {"conditions": Conditions(noise=0.1)}, r"noise=.*key=jax.random.key"),
        (Scene(), {"conditions": Conditions(dirt=0.1)}, r"dirt=.*lens=jax.random.key"),
        (Scene(), {"conditions": {"fog": 1.0}}, r"must be Conditions; got dict"),
    ],
)
def test_mistakes_are_named_before_anything_compiles(scene, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        jax.eval_shape(lambda: scene.render(**{"camera": Camera(4, 8), **options}))


@pytest.mark.slow
def test_an_image_has_the_camera_s_shape_whatever_is_traced():
    def image(x, fog):
        scene = Scene((Box((x, 0.0, 0.0), (1.0, 1.0, 1.0), hsv(x)), Sphere((9.0, x, 1.0), 1.0)))
        return scene.render(Camera(6, 10), Conditions(fog=fog)), scene.depth(Camera(6, 10))

    image, depth = jax.eval_shape(jax.vmap(image), jnp.ones(3), jnp.ones(3))
    assert image.shape == (3, 6, 10, 3)
    assert depth.shape == (3, 6, 10)
