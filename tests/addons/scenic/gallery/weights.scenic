# Weighted choices of numbers, texts, vectors and distributions.
kind = Discrete({"car": 0.7, "truck": 0.2, "bus": 0.1})
ego = new Object at Uniform(-3, 0, 3) @ 0, with width 2, with length 4
other = new Object at Uniform(0 @ 12, 5 @ 15, -5 @ 18), with kind kind,
    facing Discrete({Range(-10, 10) deg: 3, Range(170, 190) deg: 1}), with width 2, with length 4
new Object at 10 @ Discrete({5: 1, 8: 2, 11: 3}), with mass Uniform(1, 2.5, Range(3, 4))
param lights = Discrete({0: 0.25, 1: 0.75})
