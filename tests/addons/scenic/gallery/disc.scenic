# Points in a disc and in sectors.
ego = new Object at 0 @ 0, facing 30 deg
lake = CircularRegion(10 @ 5, 4)
new Object in lake, facing Range(0, 90) deg
beam = SectorRegion(0 @ 0, 20, 0.3, 1.2)
target = new Object in beam, with width 0.5, with length 0.5
near = new Object in CircularRegion(target.position, 3), with width 0.2, with length 0.2
