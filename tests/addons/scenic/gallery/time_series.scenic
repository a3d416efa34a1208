# A speed that is drawn anew at each step, as programs for VerifAI's dynamic sampling ask for it.
model scenic.simulators.newtonian.model
from scenic.core.dynamics import Action
param timeBound = 20
param verifaiSamplerType = "ce"

class SetSpeed(Action):
    def __init__(self, speed):
        self.speed = speed

    def applyTo(self, agent, simulation):
        agent.velocity = Vector(0, self.speed).rotatedBy(agent.heading)

wind = TimeSeries(VerifaiRange(-1, 1))
gear = TimeSeries(VerifaiDiscreteRange(1, 3))

behavior Drift():
    while True:
        take SetSpeed(wind.getSample() * gear.getSample())

ego = new Object at VerifaiRange(0, 1) @ 0, with behavior Drift()
record ego.position.y as y
terminate after 2 seconds
