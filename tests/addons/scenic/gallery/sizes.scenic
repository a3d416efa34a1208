# Boxes and places of random size.
width = Range(1, 3)
ego = new Object at 0 @ 0, with width width, with length 2 * width
box = new Object ahead of ego by 1, with width Range(0.5, 4), with length Normal(3, 0.2)
place = RectangularRegion(10 @ 10, Range(0, 90) deg, Range(2, 6), Range(4, 8))
new Object in place, with width 0.5, with length 0.5
