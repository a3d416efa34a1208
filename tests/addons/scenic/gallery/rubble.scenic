# A rover, a goal, and a gap between two pipes that leads to it.
workspace = Workspace(RectangularRegion(0 @ 0, 0, 5, 5))

class Rover:
    width: 0.5
    length: 0.7

class Goal:
    width: 0.2
    length: 0.2
    allowCollisions: True

class Rock:
    width: 0.15
    length: 0.15

class Pipe:
    width: 0.2
    length: Range(0.5, 1.5)

ego = new Rover at 0 @ -2
goal = new Goal at Range(-2, 2) @ Range(2, 2.4)
gap = 1.2 * ego.width
bottleneck = new OrientedPoint offset by Range(-1.5, 1.5) @ Range(0.5, 1.5), facing Range(-30, 30) deg
require abs((angle to goal) - (angle to bottleneck)) <= 20 deg
new Rock at bottleneck
leftEdge = new OrientedPoint left of bottleneck by gap / 2, facing Range(60, 120) deg relative to bottleneck.heading
rightEdge = new OrientedPoint right of bottleneck by gap / 2, facing Range(-120, -60) deg relative to bottleneck.heading
new Pipe ahead of leftEdge
new Pipe ahead of rightEdge
