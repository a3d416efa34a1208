# Objects that look at each other, or away.
ego = new Object at Range(-2, 2) @ Range(-2, 2)
a = new Object at Range(8, 12) @ Range(-3, 3), facing toward ego
b = new Object at Range(-12, -8) @ Range(-3, 3), facing away from ego
c = new Object at 0 @ 11, apparently facing Range(80, 100) deg from 3 @ 1
d = new Object at -10 @ -10, facing Range(10, 20) deg relative to a.heading
require (relative heading of a) > -2
require (apparent heading of c) > 0
