# Choices among a number of things that is random itself, and integers with random ends.
count = DiscreteRange(2, 5)
ego = new Object at 0 @ 0
other = new Object at DiscreteRange(3, count + 5) @ 8
new Object at -8 @ Uniform(*filter(lambda x: x > 1, [0, 2, 4, 6]))
param lanes = count
param seed = DiscreteRange(0, 4000000000)
