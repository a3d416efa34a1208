# Cones ahead of a car, and a broken car behind them.
workspace = Workspace(RectangularRegion(0 @ 20, 0, 30, 70))

class Cone:
    width: 0.4
    length: 0.4

ego = new Object at Range(-2, 2) @ Range(-1, 1), facing Range(-10, 10) deg,
    with width 2, with length 4.5, with speed Range(5, 15)
cone1 = new Cone ahead of ego by Range(5, 9), facing Range(0, 360) deg
cone2 = new Cone offset by Range(-4, 4) @ Range(12, 18)
new Cone at Range(-6, 6) @ Range(14, 24)
broken = new Object beyond cone2 by Range(-1, 1) @ Range(4, 8), facing Range(-60, 60) deg,
    with width 2, with length 4.5, with color Uniform("red", "blue", "white")
param brightness = TruncatedNormal(0.6, 0.2, 0, 1)
param hour = DiscreteRange(6, 20)
require (distance from cone1 to broken) > 4
