# Furniture and toys in a room.
room = RectangularRegion(0 @ 0, 0, 5.09, 5.09)
workspace = Workspace(room)

class Toy:
    width: 0.1
    length: 0.1

ego = new Object at 0 @ 0, with width 0.35, with length 0.35
table = new Object on room, with width 0.8, with length 1.2, facing Range(0, 360) deg
sofa = new Object in room, with width 0.9, with length 1.8, facing Uniform(0, 90, 180, 270) deg
for i in range(3):
    new Toy in room, with weight Range(0.1, 0.5)
require (distance from ego to table) > 1
require (distance from ego to sofa) > 1.2
