# A place that ego sees: a region that moves with it, and has no inverse.
workspace = Workspace(RectangularRegion(0 @ 0, 0, 60, 60))
ego = new Object at Range(-10, 10) @ Range(-10, 10), with visibleDistance 15
other = new Object visible, facing Range(0, 90) deg
