# The accident of Tempe as a Scenic program: what varies is that of specs/tempe.py, which runs these
# scenes through the JAX model (specs.tempe.from_scenic). No map is needed.

param notice = Range(0, 4)              # s before the turning car enters the ego's lane
param reaction = Range(0.1, 0.3)        # s
param brake = Range(6, 8.5)             # m/s^2

egoLane = PolylineRegion([(8.75, -75), (8.75, -45)])
turnLane = PolylineRegion([(-1.75, 21), (-1.75, 14)])
blockNoise = Range(-0.5, 0.5)           # m, the same for all cars that stand

class Car:
    width: 1.85
    length: 4.7

# The stopped traffic hides the turning car.
ego = new Car on egoLane, facing 0 deg, with speed Range(30, 50) / 3.6

turning = new Car on turnLane, facing 180 deg,
    with speed Range(20, 35) / 3.6,
    with delay Range(0, 3),
    with requireVisible False

# Two lanes of it, backed up into the intersection.
for lane in (1.75, 5.25):
    for place in range(9):
        new Car at (lane - blockNoise, -2.5 - 2.35 - 5.7 * place), facing 0 deg,
            with requireVisible False
