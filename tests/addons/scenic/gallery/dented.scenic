# An L-shaped yard with a pond in it: a polygon with a dent and a hole.
import shapely.geometry
outline = shapely.geometry.Polygon([(0, 0), (20, 0), (20, 8), (8, 8), (8, 20), (0, 20)],
                                   [[(2, 2), (5, 2), (5, 5), (2, 5)]])
yard = PolygonalRegion(polygon=outline)
workspace = Workspace(yard)
ego = new Object in yard, facing Range(0, 360) deg, with width 1, with length 2
other = new Object in yard, facing Range(0, 360) deg, with width 1, with length 3
