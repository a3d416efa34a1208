# Normal numbers, also with a random mean or width.
mean = Range(-1, 1)
ego = new Object at Normal(0, 0.2) @ Normal(mean, 0.1)
other = new Object at Normal(10, 1) @ TruncatedNormal(5, 2, 3, 7), facing Normal(0, 0.3)
third = new Object at TruncatedNormal(mean, 0.5, -2, 2) @ 20
param noise = Normal(0, Range(0.5, 1.5))
