# A requirement that calls the program's own function, which Scenic decides in Python.
def crowded(objects):
    places = sorted(o.position.x for o in objects)
    return any(b - a < 0.5 for a, b in zip(places, places[1:]))

ego = new Object at Range(-5, 5) @ 0, with width 0.3, with length 0.3
one = new Object at Range(-5, 5) @ 3, with width 0.3, with length 0.3
two = new Object at Range(-5, 5) @ 6, with width 0.3, with length 0.3
require not crowded([ego, one, two])
