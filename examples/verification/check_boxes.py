"""Check the proved boxes of a network's property again, with other arithmetic and other code.

    verifai-jax verify network.onnx property.vnnlib --into boxes.json
    python examples/verification/check_boxes.py network.onnx property.vnnlib boxes.json

It uses mpmath's intervals at 80 bits and no JAX, and takes only the corners of boxes from the file.
Boxes must fill the box of the inputs without overlap. In each of them it bounds the outputs by
intervals and by the mean value theorem, and halves what is too wide. It reads networks of Gemm,
MatMul, Add, Sub, Relu, Tanh and Sigmoid, and properties with bounds of inputs and one alternative.
"""

import json
import re
import sys
from fractions import Fraction
from math import prod
from pathlib import Path

import numpy as np
import onnx
from mpmath import iv, mpf

iv.prec = 80
DEPTH = 16


def affine(matrix, vector, shift):
    found = []
    for row, number in zip(matrix, shift, strict=True):
        terms = (iv.mpf(float(a)) * x for a, x in zip(row, vector, strict=True) if a)
        found.append(sum(terms, iv.mpf(float(number))))
    return found


def evaluate(layers, x, slopes):
    """Return intervals of the outputs, and of their derivatives by each input."""
    for kind, *numbers in layers:
        if kind == "affine":
            matrix, shift = numbers
            x = affine(matrix, x, shift)
            slopes = [affine(matrix, column, 0 * shift) for column in slopes]
            continue
        if kind == "Relu":
            rate = [iv.mpf([float(v.a > 0), float(v.b > 0)]) for v in x]
            x = [iv.mpf([max(v.a, 0), max(v.b, 0)]) for v in x]
        else:
            scale = 2 if kind == "Tanh" else 1
            x = [1 / (1 + iv.exp(-scale * v)) for v in x]  # it rises: the ends are its ends
            rate = [scale * scale * v * (1 - v) for v in x]
            x = [scale * v - (scale - 1) for v in x]
        slopes = [[r * s for r, s in zip(rate, column, strict=True)] for column in slopes]
    return x, slopes


def read_network(path):
    graph = onnx.load(path).graph
    arrays = {a.name: onnx.numpy_helper.to_array(a).astype(float) for a in graph.initializer}
    layers, latest = [], next(i.name for i in graph.input if i.name not in arrays)
    for node in graph.node:
        if node.op_type != "Constant" and latest not in node.input:
            sys.exit("this program knows networks that are a chain of layers")
        numbers = [arrays[name] for name in node.input if name in arrays]
        flags = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type == "Constant":
            arrays[node.output[0]] = onnx.numpy_helper.to_array(flags["value"]).astype(float)
            continue
        latest = node.output[0]
        if any(flags.get(name, 1.0) != 1.0 for name in ("alpha", "beta")) or flags.get("transA"):
            sys.exit("this program knows no scales of matrices")
        if node.op_type in ("Gemm", "MatMul"):
            left = node.input[0] in arrays or flags.get("transB")
            matrix = numbers[0] if left else numbers[0].T
            shift = numbers[1] if len(numbers) > 1 else np.zeros(len(matrix))
            layers.append(("affine", matrix, shift.ravel()))
        elif node.op_type in ("Add", "Sub"):
            if node.op_type == "Sub" and node.input[0] in arrays:
                sys.exit("this program knows no differences from a constant")
            shift = numbers[0].ravel() * (1 if node.op_type == "Add" else -1)
            layers.append(("affine", np.eye(len(shift)), shift))
        elif node.op_type in ("Relu", "Tanh", "Sigmoid"):
            layers.append((node.op_type,))
        elif node.op_type not in ("Flatten", "Reshape", "Identity", "Squeeze", "Unsqueeze"):
            sys.exit(f"this program does not know the operator {node.op_type}")
    return layers


def read_property(path):
    """Return the ends of the inputs, and sums `(factors of Y, number)` that are all <= 0."""
    text = re.sub(r";[^\n]*", "", Path(path).read_text())
    ends, sums = {}, []
    for sign, one, other in re.findall(r"\(assert\s*\(([<>]=)\s*(\S+)\s+([^\s)]+)\s*\)\s*\)", text):
        if sign == ">=":
            one, other = other, one
        name, side = (one, 1) if one[0] == "X" else (other, 0)
        if name[0] == "X":
            known = ends.setdefault(int(name[2:]), [None, None])
            known[side] = float(other if side else one)
            continue
        factors, number = {}, 0.0
        for term, factor in ((one, 1), (other, -1)):
            if term[0] == "Y":
                factors[int(term[2:])] = factors.get(int(term[2:]), 0) + factor
            else:
                number += factor * float(term)
        sums.append((factors, number))
    if text.count("assert") != 2 * len(ends) + len(sums) or not sums:
        sys.exit("this program knows one alternative of simple comparisons")
    return [ends[i] for i in range(len(ends))], sums


def holds(layers, sums, box, depth=0):
    """Return whether one of the sums is above zero at every point of a box."""
    unit = [[iv.mpf(i == j) for j in range(len(box))] for i in range(len(box))]
    middle = [iv.mpf(v.mid) for v in box]
    wide, slopes = evaluate(layers, box, unit)
    centre, _ = evaluate(layers, middle, unit)
    for factors, number in sums:
        plain = sum((f * wide[k] for k, f in factors.items()), iv.mpf(number))
        mean = sum((f * centre[k] for k, f in factors.items()), iv.mpf(number))
        for v, m, column in zip(box, middle, slopes, strict=True):
            mean += sum(f * column[k] for k, f in factors.items()) * (v - m)
        if plain.a > 0 or mean.a > 0:
            return True
    if depth >= DEPTH:
        return False
    widest = max(range(len(box)), key=lambda i: box[i].delta)
    ends = [(box[widest].a, middle[widest].b), (middle[widest].a, box[widest].b)]
    return all(
        holds(layers, sums, [*box[:widest], iv.mpf(e), *box[widest + 1 :]], depth + 1) for e in ends
    )


def main(network, rule, boxes):
    layers, (ends, sums) = read_network(network), read_property(rule)
    (corners,) = json.loads(Path(boxes).read_text())["proved"]
    boxes = [
        list(zip(map(Fraction, a), map(Fraction, b), strict=True))
        for a, b in zip(*corners, strict=True)
    ]
    if sum(prod(b - a for a, b in box) for box in boxes) != 1:
        sys.exit("the boxes do not fill the inputs")
    for i, box in enumerate(boxes):
        for other in boxes[:i]:
            if all(a < d and c < b for (a, b), (c, d) in zip(box, other, strict=True)):
                sys.exit("two boxes overlap")
        sides = []
        for (a, b), (low, high) in zip(box, ends, strict=True):
            span = iv.mpf(high) - iv.mpf(low)
            begin, end = (iv.mpf(low) + span * iv.mpf(mpf(float(s))) for s in (a, b))
            sides.append(iv.mpf([begin.a, end.b]))
        if not holds(layers, sums, sides):
            sys.exit(f"box {i + 1} is not proved")
    print(f"{len(boxes)} boxes are proved")


if __name__ == "__main__":
    main(*sys.argv[1:])
