"""Check the proved boxes of a plant again, with other arithmetic, another method and other code.

    verifai-jax verify held_pendulum_problem.py:problem --continuous --into boxes.json
    python check_plant.py held_pendulum.py boxes.json

It uses mpmath's intervals at 80 bits and no JAX, and takes only the corners of boxes from the file.
Of each step it finds a box that no solution leaves (Picard and Lindeloef), whose rates bound its
end, and it halves the features where that is too wide. Boxes must not overlap; what they fill is
printed. A plant is a file of functions, such as held_pendulum.py.
"""

import importlib.util
import json
import sys
from fractions import Fraction
from math import prod
from types import SimpleNamespace

from mpmath import iv

iv.prec = 80
STEPS, DEPTH = 16, 12
FUNCTIONS = SimpleNamespace(sin=iv.sin, tanh=lambda x: 1 - 2 / (1 + iv.exp(2 * x)))


def hull(x, y):
    return iv.mpf([min(x.a, y.a), max(x.b, y.b)])


def inside(x, y):
    return y.a <= x.a and x.b <= y.b


def holds(plant, features, depth=0):
    """Return whether the margin is at least zero at all times and for all features of a box."""
    state, length = [iv.mpf(x) for x in plant.start(features)], iv.mpf(plant.PERIOD) / STEPS
    safe = True
    for step in range(round(plant.SECONDS / plant.PERIOD) * STEPS):
        if step % STEPS == 0:
            held = plant.control(state, FUNCTIONS)
        box = state
        for _ in range(20):
            change = [r * length for r in plant.rates(box, held, features, FUNCTIONS)]
            reached = [x + hull(0 * c, c) for x, c in zip(state, change, strict=True)]
            if found := all(map(inside, reached, box)):
                break
            box = [x + iv.mpf([-1, 1]) * (x.delta / 10 + iv.mpf("1e-9")) for x in reached]
        safe = found and plant.margin(reached).a >= 0
        if not safe:
            break
        state = [x + c for x, c in zip(state, change, strict=True)]
    if safe or depth >= DEPTH:
        return safe
    widest = max(range(len(features)), key=lambda i: features[i].delta.b)
    middle = iv.mpf(features[widest].mid)
    ends = (features[widest].a, middle.b), (middle.a, features[widest].b)
    parts = ([*features[:widest], iv.mpf(each), *features[widest + 1 :]] for each in ends)
    return all(holds(plant, part, depth + 1) for part in parts)


def main(plant, boxes):
    spec = importlib.util.spec_from_file_location("plant", plant)
    plant = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(plant)
    with open(boxes) as file:
        found = json.load(file)["boxes"]
    ends = zip(found["low"], found["high"], found["state"], strict=True)
    proved = [
        [(Fraction(a), Fraction(b)) for a, b in zip(low, high, strict=True)]
        for low, high, state in ends if state == 1
    ]  # fmt: skip
    for i, box in enumerate(proved):
        for other in proved[:i]:
            if all(a < d and c < b for (a, b), (c, d) in zip(box, other, strict=True)):
                sys.exit("two boxes overlap")
        sides = []
        for (a, b), (low, high) in zip(box, plant.FEATURES.values(), strict=True):
            first, last = (
                iv.mpf(low) + (iv.mpf(high) - low) * iv.mpf(each.numerator) / each.denominator
                for each in (a, b)
            )
            sides.append(hull(first, last))
        if not holds(plant, sides):
            sys.exit(f"box {i + 1} is not proved")
    share = sum(prod(b - a for a, b in box) for box in proved)
    print(f"{len(proved)} boxes are proved, {float(share):.4g} of the features")


if __name__ == "__main__":
    main(*sys.argv[1:])
