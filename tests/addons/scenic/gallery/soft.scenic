# Requirements that hold in some scenes only.
ego = new Object at Range(-5, 5) @ 0, with width 1, with length 1
other = new Object at Range(-5, 5) @ Range(2, 8), with width 1, with length 1
require[0.5] ego.position.x > 0
require[0.8] other.position.x > ego.position.x
require (distance to other) > 3
