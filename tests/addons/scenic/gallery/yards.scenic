# Unions and differences of regions.
left = RectangularRegion(-6 @ 0, 0, 8, 8)
right = CircularRegion(6 @ 0, 4)
both = left.union(right)
ring = CircularRegion(0 @ 20, 6).difference(CircularRegion(0 @ 20, 3))
ego = new Object in both, with width 0.5, with length 0.5
other = new Object in ring, with width 0.5, with length 0.5
require other.position.y > 18
