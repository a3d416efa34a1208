# Noise on everything, by mutation.
ego = new Object at 0 @ 0
other = new Object at Range(5, 8) @ 3, facing Range(-20, 20) deg
mutate
mutate other by 2
