# Two cars on a road of OpenDRIVE, one in the lane of the other.
param map = localPath('two_lanes.xodr')
param render = False
model scenic.simulators.newtonian.driving_model

ego = new Car on road, with behavior FollowLaneBehavior(target_speed=Range(8, 12))
other = new Car ahead of ego by Range(8, 20), with behavior FollowLaneBehavior(target_speed=6),
    with requireVisible False
record (distance from ego to other) as gap
require (distance from ego to 100 @ 0) < 80
