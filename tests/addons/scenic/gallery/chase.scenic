# A car that follows another, which brakes at a time that it draws itself.
model scenic.simulators.newtonian.model
from scenic.core.dynamics import Action
param render = False

class SetSpeed(Action):
    def __init__(self, speed):
        self.speed = speed

    def applyTo(self, agent, simulation):
        agent.velocity = Vector(0, self.speed).rotatedBy(agent.heading)

class Car:
    width: 2
    length: 4.5
    speed: 10
    velocity: Vector(0, self.speed).rotatedBy(self.heading)

behavior Cruise(after):
    remaining = after + Range(0, 1)
    while True:
        remaining = remaining - 0.1
        take SetSpeed(10 if remaining > 0 else 4)

behavior Follow(target, keep):
    while True:
        gap = (distance from self to target) - self.length
        take SetSpeed(max(0, min(14, 10 + 0.8 * (gap - keep))))

lead = new Car at 0 @ Range(15, 30), with behavior Cruise(Range(0.5, 2)), with requireVisible False
ego = new Car at 0 @ 0, with behavior Follow(lead, Range(2, 8))
record (distance from ego to lead) - 4.5 as gap
record ego.position as place
require always (distance from ego to lead) > 1
terminate after 5 seconds
