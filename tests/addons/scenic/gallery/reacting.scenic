# A car that brakes as an adversary answers the gap, before one that follows it.
model scenic.simulators.newtonian.model
from scenic.core.dynamics import Action

class SetSpeed(Action):
    def __init__(self, speed):
        self.speed = speed

    def applyTo(self, agent, simulation):
        agent.velocity = Vector(0, self.speed).rotatedBy(agent.heading)
        agent.speed = self.speed

class Car:
    width: 2
    length: 4.5
    speed: 10
    velocity: Vector(0, self.speed).rotatedBy(self.heading)

behavior Tease(other):
    speed = 10
    while True:
        gap = (distance from self to other) - self.length
        speed = max(0, min(14, speed + 0.1 * globalParameters.push(gap=gap, speed=speed)))
        take SetSpeed(speed)

behavior Follow(target):
    speed = 10
    while True:
        gap = (distance from self to target) - self.length
        wanted = max(0, min(14, 10 + 0.8 * (gap - 8)))
        speed = speed + max(-0.6, min(0.3, wanted - speed))
        take SetSpeed(speed)

ego = new Car at 0 @ 0, with requireVisible False
lead = new Car at 0 @ Range(12, 16), with behavior Tease(ego), with requireVisible False
ego.behavior = Follow(lead)
record (distance from ego to lead) - 4.5 as gap
terminate after 6 seconds
