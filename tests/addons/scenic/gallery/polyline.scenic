# Objects along a road that bends.
road = PolylineRegion([0 @ 0, 20 @ 0, 40 @ 20, 40 @ 60])
ego = new Object on road, with width 2, with length 4, with visibleDistance 100
other = new Object on road, facing Range(-5, 5) deg relative to road.orientation,
    with width 2, with length 4
beside = new Object left of other by Range(0.5, 2), with width 1, with length 1
