# A rectangle that stands at an angle, as workspace and as place.
field = RectangularRegion(3 @ 4, 40 deg, 12, 20)
workspace = Workspace(field)
ego = new Object in field, facing 40 deg, with width 1, with length 2
other = new Object in field, facing Range(0, 180) deg, with width 1, with length 2
