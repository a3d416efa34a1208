# A car parked at an angle beside a curb.
curb = PolylineRegion([0 @ 0, 0 @ 40, 10 @ 70, 30 @ 90])
ego = new Object at -4 @ 5, with width 2, with length 4.5, with visibleDistance 120
spot = new OrientedPoint on curb
angle = Uniform(1.0, -1.0) * Range(10, 20) deg
parked = new Object left of spot by 0.3, facing angle relative to spot.heading,
    with width 2, with length 4.5
require (distance to parked) > 8
