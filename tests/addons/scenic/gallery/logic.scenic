# Requirements with arithmetic, logic, functions and regions.
import math
zone = RectangularRegion(10 @ 10, 30 deg, 10, 6)
bay = CircularRegion(-10 @ 10, 5)
ego = new Object at Range(-3, 3) @ Range(-3, 3)
other = new Object at Range(3, 16) @ Range(4, 16), facing Range(-90, 90) deg
third = new Object at Range(-16, -4) @ Range(4, 16)
require other in zone or other.position.y < 8
require third.position in bay
require not (ego.position.x > 2 and ego.position.y > 2)
require (other.position.x > 6) implies (abs(relative heading of other) < 60 deg)
require math.hypot(ego.position.x, ego.position.y) < 4
require 2 < (distance from other to 10 @ 10) ** 2 + 1 <= 80
