# Classes with random properties that depend on each other.
class Vehicle:
    width: Range(1.6, 2.2)
    length: self.width * 2.2
    weight: Range(900, 1600)
    brake: max(3.0, 9.0 - self.weight / 400)

class Truck(Vehicle):
    length: Range(7, 12)
    weight: Normal(12000, 800)

ego = new Vehicle at 0 @ 0
truck = new Truck at Range(5, 9) @ Range(4, 30), facing Range(-5, 5) deg
new Vehicle at Range(-9, -5) @ Range(4, 30), with brake min(truck.brake + 1, 6)
require abs(truck.position.y - ego.position.y) > 6
